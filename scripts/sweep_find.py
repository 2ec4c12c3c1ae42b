"""How a find stands what cameras, lights and rooms may be like: the built-in workcell, one thing changed at a time.

Usage: python sweep_find.py [--program target/release/vergence] [--seeds 12] [--jobs 2]

Each line: one change in workcell.toml, every object of the workcell found at that many seeds; how many are
found, how many of these lie within 10 mm of the simulator's truth, of how many the 95 % ellipsoid of the
position holds the truth, and their median and 90 % error.
"""
import argparse, concurrent.futures, json, math, os, subprocess, tempfile

# What the configuration says of the zeros of either head.
TOLD = 2 * [("zero_sd_deg = 0.0", "zero_sd_deg = 0.3")]
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
    "joint zeros off by 0.1 deg": [("joint_zero_deg = 0.0", "joint_zero_deg = 0.1")],
    "joint zeros off by 0.3 deg": [("joint_zero_deg = 0.0", "joint_zero_deg = 0.3")],
    "the same, zero_sd_deg = 0.3": [("joint_zero_deg = 0.0", "joint_zero_deg = 0.3"), *TOLD],
    "joint zeros right, zero_sd_deg = 0.3": TOLD,
}
OBJECTS = ("box", "cup", "can")
RIGHT_MM = 10.0
CHI2_95 = 7.815  # of three degrees of freedom


def determinant(m):
    (a, b, c), (d, e, f), (g, h, i) = m
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def squared(covariance, error):
    """error' covariance^-1 error, by Cramer's rule."""
    replaced = lambda k: [[error[i] if j == k else covariance[i][j] for j in range(3)] for i in range(3)]
    whole = determinant(covariance)
    return sum(error[k] * determinant(replaced(k)) / whole for k in range(3))


def find(program, config, name, seed):
    """Error of the position (mm) and whether its ellipsoid holds the truth, or why there is no position."""
    command = [program, "find", name, "--config", config, "--seed", str(seed), "--json"]
    ran = subprocess.run(command, capture_output=True, text=True)
    report = json.loads(ran.stdout or '{"reason": "no report"}')
    if not report.get("found"):
        return report["reason"]
    pose, truth = report["pose"], report["truth"]["position"]
    error = [1e3 * (a - b) for a, b in zip(pose["position"], truth)]
    # Rotation comes first in a pose's covariance.
    covariance = [[1e6 * pose["covariance"][6 * (i + 3) + j + 3] for j in range(3)] for i in range(3)]
    return math.hypot(*error), squared(covariance, error) < CHI2_95


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/vergence")
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    print(f"{'':<36} {'runs':>5} {'found':>6} {'right':>6} {'held':>6} {'med mm':>7} {'p90 mm':>7}")
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
            found = [r for r in results if not isinstance(r, str)]
            errors = sorted(error for error, _ in found)
            right, held = sum(e <= RIGHT_MM for e in errors), sum(holds for _, holds in found)
            at = lambda share: errors[min(int(share * len(errors)), len(errors) - 1)] if errors else math.nan
            print(f"{change:<36} {len(runs):>5} {len(errors):>6} {right:>6} {held:>6} {at(0.5):>7.2f} {at(0.9):>7.2f}", flush=True)


main()
