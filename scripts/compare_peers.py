"""What a user would take otherwise, on the same pictures: AprilTag on the object, ViSP's edge tracker.

Usage: python compare_peers.py SET [--program target/release/vergence] [--visp visp_edges] [--save DIR]
       (needs opencv-python-headless, pupil-apriltags, numpy; SET: layout in docs/pose.md, with its truth)

`vergence evaluate pose --scenes 100 --save SET` draws a set. Three tables:
- vergence on every scene, its rotation unknown at the start.
- AprilTag (family 36h11) on the boxes: on the face that looks most at the left camera a marker as large
  as fits is painted into both pictures, as well printed and lit as one could wish, in front of whatever
  hides the object. Detected and placed by OpenCV and by AprilTag 3, from one camera and from both.
- With --visp (scripts/visp_edges.cpp): ViSP's tracker on boxes and cylinders with both cameras, put on
  the landmark and turned off the truth by given angles; for each the better of several search ranges.
Errors are of the bounding box's centre and of the rotation, an axis's for solids of revolution; wrong
is what is answered and off by more than 10 mm or 5 degrees. The markers' times are their detection only.
"""
import argparse, csv, glob, itertools, json, os, statistics, subprocess, tempfile, time

import cv2
import numpy as np

PAPER, INK, NOISE, BLUR_PX = 200.0, 30.0, 2.0, 0.5
MODULES, FINER = 8, 4
TURNS_DEG, TRIALS, RANGES_PX = (0, 2, 5, 10, 20, 30), 4, (5, 8, 15)


def read(path):
    return next(iter(json.load(open(path)).values()))


def rigid(rotation, translation_mm):
    pose = np.eye(4)
    pose[:3, :3] = np.array(rotation, float).reshape(3, 3)
    pose[:3, 3] = np.array(translation_mm, float) * 1e-3
    return pose


class Scene:
    def __init__(self, folder):
        self.number = int(os.path.basename(folder))
        self.pictures = [cv2.imread(f"{folder}/gray_{side}/000000.png", cv2.IMREAD_GRAYSCALE) for side in ("left", "right")]
        cameras = [read(f"{folder}/scene_camera_{side}.json") for side in ("left", "right")]
        self.k = [np.array(c["cam_K"], float).reshape(3, 3) for c in cameras]
        if any(any(c.get("cam_dist") or [0]) for c in cameras):
            raise SystemExit(f"{folder}: the peers are run on pictures without distortion only")
        world = [rigid(c["cam_R_w2c"], c["cam_t_w2c"]) for c in cameras]
        entry = read(f"{folder}/scene_tags.json")[0]
        self.landmark = (world[0] @ np.append(np.array(entry["landmark_w"]) * 1e-3, 1))[:3]
        tag = entry["tag"]
        self.kind = tag["shape"]["kind"]
        self.sides = np.array([tag["bounding_box"][s] for s in ("width", "length", "height")])
        self.on_object = np.array(tag["landmarks"][0]["position"])
        truth = read(f"{folder}/scene_gt_left.json")[0]
        left = rigid(truth["cam_R_m2c"], truth["cam_t_m2c"])
        self.right_from_left = world[1] @ np.linalg.inv(world[0])
        self.truth = [left, self.right_from_left @ left]

    def error(self, pose):
        """Millimetres and degrees of a left_from_object."""
        truth = self.truth[0]
        turn = pose[:3, :3].T @ truth[:3, :3]
        if self.kind == "box":
            cosines = [(np.trace(turn @ s) - 1) / 2 for s in self.symmetries()]
        else:
            c = turn[2, 2]
            ends_alike = self.kind == "cylinder" and abs(2 * self.on_object[2]) < 0.004
            cosines = [abs(c) if ends_alike else c]
        angle = np.degrees(np.arccos(np.clip(max(cosines), -1, 1)))
        return 1e3 * np.linalg.norm(pose[:3, 3] - truth[:3, 3]), angle

    def symmetries(self):
        """Of a box: those that leave the landmark within 4 mm."""
        for order in itertools.permutations(range(3)):
            for signs in itertools.product((1, -1), repeat=3):
                turn = np.zeros((3, 3))
                turn[range(3), order] = signs
                fits = np.linalg.det(turn) > 0 and np.allclose(self.sides[list(order)], self.sides, atol=5e-4)
                if fits and np.linalg.norm(turn @ self.on_object - self.on_object) < 0.004:
                    yield turn


class Tally:
    """Errors of answers; a scene without one counts as infinitely wrong."""

    def __init__(self, tried):
        self.tried, self.errors, self.ms = tried, [], []

    def add(self, error, ms):
        self.errors.append(error)
        self.ms.append(ms)

    def __str__(self):
        within = lambda mm, deg: sum(p <= mm and r <= deg for p, r in self.errors) / self.tried
        missing = [(np.inf, np.inf)] * (self.tried - len(self.errors))
        mm, deg = (statistics.median(column) for column in zip(*(self.errors + missing)))
        wrong = sum(p > 10 or r > 5 for p, r in self.errors)
        ms = f"{statistics.median(self.ms):8.2f}" if self.ms else "       -"
        return f"{self.tried:>6} {len(self.errors):>8} {within(5, 5):>9.3f} {within(2, 2):>9.3f} {mm:>7.2f} {deg:>7.2f} {wrong:>6} {ms}"


HEAD = f"{'':<34} {'tried':>6} {'answered':>8} {'5 mm 5deg':>9} {'2 mm 2deg':>9} {'med mm':>7} {'med deg':>7} {'wrong':>6} {'med ms':>8}"


def show(name, tally):
    print(f"{name:<34} {tally}", flush=True)


def ours(folder, scenes, program):
    with tempfile.TemporaryDirectory() as scratch:
        out = os.path.join(scratch, "results.csv")
        subprocess.run([program, "pose", folder, "--out", out], stderr=subprocess.DEVNULL, check=False)
        rows = {int(row["scene_id"]): row for row in csv.DictReader(open(out))}
    found = {}
    for scene in scenes:
        if row := rows.get(scene.number):
            numbers = lambda name: list(map(float, row[name].split()))
            found[scene.number] = scene.error(rigid(numbers("R"), numbers("t"))), 1e3 * float(row["time"])
    return found


def of_kinds(found, scenes, kinds):
    some = [s for s in scenes if s.kind in kinds]
    tally = Tally(len(some))
    for scene in some:
        if scene.number in found:
            tally.add(*found[scene.number])
    return tally


# The marker.

DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
CODE = cv2.aruco.generateImageMarker(DICTIONARY, 0, MODULES) > 127
# Corners of the black square in the marker's plane, x right and y down as printed, for a side of one.
SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) / 2


def marker(scene):
    """object_from_marker on the face that looks most at the left camera, z into the object, and the black
    square's side."""
    eye = np.linalg.inv(scene.truth[0])[:3, 3]
    half = scene.sides / 2
    faces = [(axis, sign) for axis in range(3) for sign in (-1, 1)]
    facing = lambda f: (f[1] * eye[f[0]] - half[f[0]]) / np.linalg.norm(eye - np.eye(3)[f[0]] * f[1] * half[f[0]])
    axis, sign = max(faces, key=facing)
    into = -sign * np.eye(3)[axis]
    right = np.eye(3)[(axis + 1) % 3]
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(into, right), into])
    pose[axis, 3] = sign * half[axis]
    # A module of white around it.
    return pose, min(np.delete(scene.sides, axis)) * MODULES / (MODULES + 2)


def paint(picture, k, optical_from_marker, side, rng):
    """The picture with the marker: averaged over the pixels, blurred, with noise."""
    height, width = picture.shape
    fine = lambda n: (np.arange(n * FINER) + 0.5) / FINER - 0.5
    u, v = np.meshgrid(fine(width), fine(height))
    rays = np.stack([(u - k[0, 2]) / k[0, 0], (v - k[1, 2]) / k[1, 1], np.ones_like(u)], axis=-1)
    turn, place = optical_from_marker[:3, :3], optical_from_marker[:3, 3]
    depth = (turn[:, 2] @ place) / (rays @ turn[:, 2])
    on_plane = (rays * depth[..., None] - place) @ turn / side * MODULES
    x, y = on_plane[..., 0] + MODULES / 2, on_plane[..., 1] + MODULES / 2
    paper = (depth > 0) & (np.minimum(x, y) >= -1) & (np.maximum(x, y) < MODULES + 1)
    cell = lambda c: np.clip(np.floor(c), 0, MODULES - 1).astype(int)
    inside = (np.minimum(x, y) >= 0) & (np.maximum(x, y) < MODULES)
    white = CODE[cell(y), cell(x)] | ~inside
    light = np.where(white, PAPER, INK) * paper
    blurred = lambda a: cv2.GaussianBlur(a.reshape(height, FINER, width, FINER).mean(axis=(1, 3)), (0, 0), BLUR_PX)
    light, share = blurred(light), blurred(paper.astype(float))
    noisy = light + (1 - share) * picture + rng.normal(0, NOISE, picture.shape) * share
    return np.clip(np.round(noisy), 0, 255).astype(np.uint8)


def opencv_detector():
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(DICTIONARY, parameters)

    def detect(picture):
        corners, ids, _ = detector.detectMarkers(picture)
        ids = [] if ids is None else np.ravel(ids)
        return next((np.reshape(c, (4, 2)).astype(float) for c, i in zip(corners, ids) if i == 0), None)

    return detect


def apriltag_detector():
    import pupil_apriltags

    detector = pupil_apriltags.Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)

    def detect(picture):
        found = [d for d in detector.detect(picture) if d.tag_id == 0]
        # Its corners lie half a pixel on: its pixel centres are at one half.
        return found[0].corners - 0.5 if found else None

    # Which corner it counts first, read off an upright marker.
    code = np.kron(np.pad(CODE, 2, constant_values=True), np.ones((20, 20))) * 255
    upright = detect(code.astype(np.uint8))
    middle = SQUARE[:, :2] * MODULES * 20 + len(code) / 2
    order = [int(np.argmin(np.linalg.norm(upright - c, axis=1))) for c in middle]
    return lambda picture: None if (corners := detect(picture)) is None else corners[order]


def residuals(pose, points, cameras):
    out = []
    for corners, k, view_from_left in cameras:
        seen = (view_from_left @ pose @ points)[:3]
        pixels = (k @ (seen / seen[2]))[:2].T
        out.append((pixels - corners).ravel())
    return np.concatenate(out)


def refined(pose, points, cameras):
    """Least squares of the corners in all pictures, from a start."""
    for _ in range(20):
        r = residuals(pose, points, cameras)

        def moved(step):
            change = np.eye(4)
            change[:3, :3] = cv2.Rodrigues(step[:3])[0]
            change[:3, 3] = step[3:]
            return pose @ change

        j = np.column_stack([(residuals(moved(1e-6 * e), points, cameras) - r) / 1e-6 for e in np.eye(6)])
        pose = moved(-np.linalg.lstsq(j, r, rcond=None)[0])
    return pose


def placed(scene, side, corners, both):
    """left_from_marker from its corners: of the two poses a square allows the one that fits better."""
    object_points = SQUARE * side
    _, turns, shifts, _ = cv2.solvePnPGeneric(object_points * [1, -1, 1], corners[0], scene.k[0], None, flags=cv2.SOLVEPNP_IPPE_SQUARE)
    flip = np.diag([1.0, -1, -1, 1])
    cameras = [(corners[0], scene.k[0], np.eye(4))]
    if both:
        cameras.append((corners[1], scene.k[1], scene.right_from_left))
    points = np.column_stack([object_points, np.ones(4)]).T
    poses = []
    for turn, shift in zip(turns, shifts):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(turn)[0]
        pose[:3, 3] = shift.ravel()
        poses.append(refined(pose @ flip, points, cameras))
    return min(poses, key=lambda p: np.linalg.norm(residuals(p, points, cameras)))


def markers(scenes, save):
    boxes = [s for s in scenes if s.kind == "box"]
    detectors = {"OpenCV": opencv_detector(), "AprilTag 3": apriltag_detector()}
    tallies = {(name, both): Tally(len(boxes)) for name in detectors for both in (False, True)}
    for scene in boxes:
        rng = np.random.default_rng(scene.number)
        object_from_marker, side = marker(scene)
        pictures = [paint(p, k, t @ object_from_marker, side, rng) for p, k, t in zip(scene.pictures, scene.k, scene.truth)]
        if save:
            os.makedirs(save, exist_ok=True)
            cv2.imwrite(os.path.join(save, f"{scene.number:06}.png"), pictures[0])
        for name, detect in detectors.items():
            for both in (False, True):
                used = pictures[: 1 + both]
                start = time.perf_counter()
                corners = [detect(p) for p in used]
                ms = 1e3 * (time.perf_counter() - start)
                if all(c is not None for c in corners):
                    pose = placed(scene, side, corners, both) @ np.linalg.inv(object_from_marker)
                    tallies[name, both].add(scene.error(pose), ms)
    for (name, both), tally in tallies.items():
        show(f"AprilTag, {name}, {'both cameras' if both else 'left camera'}", tally)


# ViSP.


def cao(scene):
    """The object in ViSP's format."""
    half = scene.sides / 2
    if scene.kind == "cylinder":
        ends = f"0 0 {-half[2]}\n0 0 {half[2]}\n"
        return f"V1\n2\n{ends}0\n0\n0\n1\n0 1 {half[0]}\n0\n"
    corners = "".join(f"{x} {y} {z}\n" for x, y, z in itertools.product(*([-h, h] for h in half)))
    faces = ["0 1 3 2", "4 6 7 5", "0 4 5 1", "2 3 7 6", "0 2 6 4", "1 5 7 3"]
    return f"V1\n8\n{corners}0\n0\n6\n" + "".join(f"4 {f}\n" for f in faces) + "0\n0\n"


def started(scene, turn_deg, rng):
    """The truth turned about its landmark, which is where the robot measured it."""
    axis = rng.normal(size=3)
    turn = cv2.Rodrigues(np.radians(turn_deg) * axis / np.linalg.norm(axis))[0]
    pose = np.eye(4)
    pose[:3, :3] = scene.truth[0][:3, :3] @ turn
    pose[:3, 3] = scene.landmark - pose[:3, :3] @ scene.on_object
    return pose


def visp(scenes, program):
    some = [s for s in scenes if s.kind in ("box", "cylinder")]
    text = lambda numbers: " ".join(f"{v:.12g}" for v in np.ravel(numbers))
    tallies = {(turn, reach): Tally(TRIALS * len(some)) for turn in TURNS_DEG for reach in RANGES_PX}
    with tempfile.TemporaryDirectory() as scratch:
        for scene in some:
            paths = [os.path.join(scratch, name) for name in ("model.cao", "left.pgm", "right.pgm")]
            open(paths[0], "w").write(cao(scene))
            for path, picture in zip(paths[1:], scene.pictures):
                cv2.imwrite(path, picture)
            rng = np.random.default_rng(scene.number)
            turns = [turn for turn in TURNS_DEG for _ in range(TRIALS)]
            starts = [started(scene, turn, rng) for turn in turns]
            lenses = [[k[0, 0], k[1, 1], k[0, 2], k[1, 2]] for k in scene.k]
            lines = [text(v) for v in (*lenses, scene.right_from_left)] + [str(len(starts)), *map(text, starts)]
            for reach in RANGES_PX:
                ran = subprocess.run([program, *paths, str(reach)], input="\n".join(lines), text=True, capture_output=True, check=True)
                answers = [a for a in ran.stdout.splitlines() if a == "lost" or len(a.split()) == 17]
                assert len(answers) == len(starts), ran.stderr
                for turn, answer in zip(turns, answers):
                    if answer != "lost":
                        ms, *pose = map(float, answer.split())
                        tallies[turn, reach].add(scene.error(np.reshape(pose, (4, 4))), ms)
    right = lambda tally: sum(p <= 5 and r <= 5 for p, r in tally.errors)
    for turn in TURNS_DEG:
        reach = max(RANGES_PX, key=lambda reach: right(tallies[turn, reach]))
        show(f"ViSP, turned {turn} deg, range {reach} px", tallies[turn, reach])


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("set")
    parser.add_argument("--program", default="target/release/vergence")
    parser.add_argument("--save", help="folder for the left pictures with their markers")
    parser.add_argument("--visp", help="visp_edges, built from scripts/visp_edges.cpp")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    scenes = [Scene(folder) for folder in sorted(glob.glob(os.path.join(args.set, "test", "*")))]
    print(HEAD)
    found = ours(args.set, scenes, args.program)
    show("vergence", of_kinds(found, scenes, {s.kind for s in scenes}))
    show("vergence, boxes", of_kinds(found, scenes, {"box"}))
    show("vergence, boxes and cylinders", of_kinds(found, scenes, {"box", "cylinder"}))
    markers(scenes, args.save)
    if args.visp:
        visp(scenes, args.visp)


main()
