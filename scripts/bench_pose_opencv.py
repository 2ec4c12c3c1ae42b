"""Time of the whole recognition against OpenCV doing only Canny and the exact distance transform.

Usage: python bench_pose_opencv.py SET [path to the program vergence]     (needs opencv-python-headless)

Both work on the same pictures on one thread in one run: OpenCV the two steps on every picture of a
scene (smallest of 50 calls), vergence the whole recognition (smallest of 5 runs of the command over
the set). Prints both medians and their ratio, by picture size.
"""
import collections, csv, glob, os, statistics, subprocess, sys, tempfile, time

import cv2

folder = sys.argv[1]
program = sys.argv[2] if len(sys.argv) > 2 else "target/release/vergence"
cv2.setNumThreads(1)


def opencv_seconds(pictures):
    best = float("inf")
    for _ in range(50):
        start = time.perf_counter()
        for picture in pictures:
            edges = cv2.Canny(picture, 40, 100)
            cv2.distanceTransform(255 - edges, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        best = min(best, time.perf_counter() - start)
    return best


def vergence_seconds():
    best = {}
    with tempfile.TemporaryDirectory() as scratch:
        out = os.path.join(scratch, "results.csv")
        for _ in range(5):
            subprocess.run([program, "pose", folder, "--out", out, "--threads", "1"], stderr=subprocess.DEVNULL)
            for row in csv.DictReader(open(out)):
                scene = int(row["scene_id"])
                best[scene] = min(best.get(scene, float("inf")), float(row["time"]))
    return best


ours = vergence_seconds()
rows = collections.defaultdict(list)
for scene_folder in sorted(glob.glob(os.path.join(folder, "test", "*"))):
    scene = int(os.path.basename(scene_folder))
    pictures = [cv2.imread(path, cv2.IMREAD_GRAYSCALE) for path in sorted(glob.glob(scene_folder + "/gray_*/*.*"))]
    if scene in ours and pictures:
        height, width = pictures[0].shape
        rows[f"{len(pictures)} x {width}x{height}"].append((opencv_seconds(pictures), ours[scene]))
print(f"{'pictures':<16} {'scenes':>6} {'OpenCV ms':>10} {'vergence ms':>12} {'ratio':>6}")
for size, pairs in sorted(rows.items()):
    theirs, mine = (statistics.median(p[k] for p in pairs) * 1e3 for k in (0, 1))
    print(f"{size:<16} {len(pairs):>6} {theirs:>10.2f} {mine:>12.2f} {mine / theirs:>6.2f}")
