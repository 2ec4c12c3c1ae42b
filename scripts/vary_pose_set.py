"""Variants of a pose set, so that a change is not judged by the very pictures it was made with.

Usage: python vary_pose_set.py SET OUT [--mirror] [--half] [--elsewhere] [--seed N]     (needs numpy, pillow)

Writes the scenes of SET (layout: docs/pose.md) to OUT with another error of the landmark, drawn
from its covariance; with --mirror as seen in a mirror (every form in a record is its own mirror
image, but for prisms and convex bodies, which are left out), with --half at half the size, with
--elsewhere with the landmark where the object is not: to the side by 0.8 to 1.3 times its diagonal, so
that every answer is wrong.
"""
import argparse, json, os, shutil

import numpy as np
from PIL import Image

OBJECT = CAMERA = np.diag([-1.0, 1.0, 1.0])


def read(path):
    return json.load(open(path))


def write(path, value):
    json.dump(value, open(path, "w"))


def matrix(values):
    return np.array(values, float).reshape(3, 3)


def mirror_view(camera, truth, world, width):
    k, r, t = matrix(camera["cam_K"]), matrix(camera["cam_R_w2c"]), np.array(camera["cam_t_w2c"])
    k[0, 2] = width - 1 - k[0, 2]
    camera.update(cam_K=k.ravel().tolist(), cam_R_w2c=(CAMERA @ r @ world).ravel().tolist(), cam_t_w2c=(CAMERA @ t).tolist())
    if "pan" in camera:
        camera["pan"] = -camera["pan"]
    if camera.get("cam_dist"):
        camera["cam_dist"][3] = -camera["cam_dist"][3]
    r, t = matrix(truth["cam_R_m2c"]), np.array(truth["cam_t_m2c"])
    truth.update(cam_R_m2c=(CAMERA @ r @ OBJECT).ravel().tolist(), cam_t_m2c=(CAMERA @ t).tolist())


def halve(camera):
    k = matrix(camera["cam_K"])
    k[:2, 2] = (k[:2, 2] + 0.5) / 2 - 0.5
    k[0, 0], k[1, 1] = k[0, 0] / 2, k[1, 1] / 2
    camera["cam_K"] = k.ravel().tolist()


def beside(landmark, box, camera, picture, rng):
    k, turn = matrix(camera["cam_K"]), matrix(camera["cam_R_w2c"])
    size = np.array(Image.open(picture).size)
    diagonal = 1000 * np.linalg.norm([box[side] for side in ("width", "length", "height")])
    for _ in range(100):
        angle = rng.uniform(0, 2 * np.pi)
        aside = diagonal * rng.uniform(0.8, 1.3) * np.array([np.cos(angle), np.sin(angle), 0])
        place = landmark + turn.T @ aside
        pixel = k @ (turn @ place + camera["cam_t_w2c"])
        if np.all((pixel[:2] > 0) & (pixel[:2] < pixel[2] * size)):
            return place
    raise SystemExit(f"{picture}: shows nothing beside the object")


def vary(source, target, args, rng):
    tags = read(f"{source}/scene_tags.json")
    key = next(iter(tags))
    entry = tags[key][0]
    if args.mirror and entry["tag"]["shape"]["kind"] not in ("box", "cylinder", "cup", "sphere"):
        return
    sides = [s for s in ("left", "right") if os.path.exists(f"{source}/scene_camera_{s}.json")]
    cameras = {s: read(f"{source}/scene_camera_{s}.json") for s in sides}
    truths = {s: read(f"{source}/scene_gt_{s}.json") for s in sides}
    # The truth gives the place about which the landmark is drawn anew.
    camera, truth = cameras["left"][key], truths["left"][key][0]
    place = 1000 * np.array(entry["tag"]["landmarks"][0]["position"])
    place = matrix(truth["cam_R_m2c"]) @ place + np.array(truth["cam_t_m2c"]) - np.array(camera["cam_t_w2c"])
    covariance = matrix(entry["landmark_cov_w"])
    landmark = matrix(camera["cam_R_w2c"]).T @ place + rng.multivariate_normal(np.zeros(3), covariance)
    if args.elsewhere:
        landmark = beside(landmark, entry["tag"]["bounding_box"], camera, f"{source}/gray_left/{int(key):06d}.png", rng)
    # A robot's base is mirrored left to right; without one the world is the camera.
    world = np.diag([1.0, -1.0, 1.0]) if "pan" in camera else CAMERA
    if args.mirror:
        landmark, covariance = world @ landmark, world @ covariance @ world
        for site in entry["tag"]["landmarks"]:
            site["position"][0], site["normal"][0] = -site["position"][0], -site["normal"][0]
    entry.update(landmark_w=landmark.tolist(), landmark_cov_w=covariance.ravel().tolist())
    for side in sides:
        os.makedirs(f"{target}/gray_{side}", exist_ok=True)
        picture = Image.open(f"{source}/gray_{side}/{int(key):06d}.png")
        if args.mirror:
            mirror_view(cameras[side][key], truths[side][key][0], world, picture.width)
            picture = picture.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
        if args.half:
            halve(cameras[side][key])
            picture = picture.resize((picture.width // 2, picture.height // 2), Image.Resampling.BOX)
        picture.save(f"{target}/gray_{side}/{int(key):06d}.png")
        write(f"{target}/scene_camera_{side}.json", cameras[side])
        write(f"{target}/scene_gt_{side}.json", truths[side])
    write(f"{target}/scene_tags.json", tags)
    if os.path.exists(f"{source}/scene_info.json"):
        shutil.copy(f"{source}/scene_info.json", target)


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("set")
parser.add_argument("out")
parser.add_argument("--mirror", action="store_true")
parser.add_argument("--half", action="store_true")
parser.add_argument("--elsewhere", action="store_true")
parser.add_argument("--seed", type=int, default=0)
args = parser.parse_args()
rng = np.random.default_rng(args.seed)
for name in sorted(os.listdir(f"{args.set}/test")):
    vary(f"{args.set}/test/{name}", f"{args.out}/test/{name}", args, rng)
