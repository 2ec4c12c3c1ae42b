"""How a find stands what cameras, lights and rooms may be like: the built-in workcell, one thing changed at a time.

Usage: python sweep_find.py [--program target/release/vergence] [--seeds 12] [--jobs 2]

Each line: one change in workcell.toml, every object of the workcell found at that many seeds; how many are
found, how many of these lie within 10 mm of the simulator's truth, and their median and 90 % error.
"""
import argparse, concurrent.futures, json, math, os, subprocess, tempfile

CHANGES = {
    "as it is": [],
    "light 7 times brighter": [("flux_px = 4.0", "flux_px = 30.0")],
    "light 7 times dimmer": [("flux_px = 4.0", "flux_px = 0.6")],
    "exposure 1 ms": [("exposure = 0.004", "exposure = 0.001")],
    "exposure 20 ms, gain to match": [("exposure = 0.004", "exposure = 0.020"), ("gain = 1.0", "gain = 0.25")],
    "exposure 16 ms, overexposed": [("exposure = 0.004", "exposure = 0.016")],
    "15 frames a second": [("frame_rate = 30.0", "frame_rate = 15.0")],
    "60 frames a second": [("frame_rate = 30.0", "frame_rate = 60.0")],
    "rolling shutter, JPEG, noise": [("row_time = 0.0", "row_time = 0.00008"), ("jpeg_quality = 0", "jpeg_quality = 50"), ("read_noise = 8.0", "read_noise = 25.0")],
    "lens twice as soft": [("psf_sigma_px = 0.6", "psf_sigma_px = 1.2")],
    "room at 15 %": [("brightness = 1.0", "brightness = 0.15")],
    "lamp that flickers by 90 %": [("lamp_depth = 0.35", "lamp_depth = 0.9")],
    "servo steps of 1 deg, slack 0.5": [("resolution_deg = 0.35", "resolution_deg = 1.0"), ("backlash_deg = 0.15", "backlash_deg = 0.5")],
    "25 other things": [("clutter = 9", "clutter = 25")],
    "objects fallen": [('scenario = "default"', 'scenario = "fallen"')],
    "joint zeros off by 0.3 deg": [("joint_zero_deg = 0.0", "joint_zero_deg = 0.3")],
}
OBJECTS = ("box", "cup", "can")
RIGHT_MM = 10.0


def find(program, config, name, seed):
    """Error of the position (mm), or why there is none."""
    command = [program, "find", name, "--config", config, "--seed", str(seed), "--json"]
    ran = subprocess.run(command, capture_output=True, text=True)
    report = json.loads(ran.stdout or '{"reason": "no report"}')
    if not report.get("found"):
        return report["reason"]
    return 1e3 * math.dist(report["pose"]["position"], report["truth"]["position"])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/vergence")
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    print(f"{'':<34} {'runs':>5} {'found':>6} {'right':>6} {'med mm':>7} {'p90 mm':>7}")
    with tempfile.TemporaryDirectory() as folder, concurrent.futures.ThreadPoolExecutor(args.jobs) as pool:
        subprocess.run([args.program, "workcell", folder], check=True, capture_output=True)
        config = os.path.join(folder, "workcell.toml")
        built_in = open(config).read()
        for change, edits in CHANGES.items():
            text = built_in
            for old, new in edits:
                assert old in text, old
                text = text.replace(old, new, 1)
            open(config, "w").write(text)
            runs = [(name, seed) for seed in range(1, args.seeds + 1) for name in OBJECTS]
            results = list(pool.map(lambda run: find(args.program, config, *run), runs))
            errors = sorted(r for r in results if not isinstance(r, str))
            right = sum(e <= RIGHT_MM for e in errors)
            at = lambda share: errors[min(int(share * len(errors)), len(errors) - 1)] if errors else math.nan
            print(f"{change:<34} {len(runs):>5} {len(errors):>6} {right:>6} {at(0.5):>7.2f} {at(0.9):>7.2f}", flush=True)


main()
