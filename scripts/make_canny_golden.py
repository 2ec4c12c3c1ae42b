"""Writes the golden files of crates/pose/tests/canny_golden.rs: a picture and OpenCV's edges of it.

Usage: python make_canny_golden.py crates/pose/tests/data      (needs opencv-python-headless, numpy)
"""
import sys

import cv2
import numpy as np

folder = sys.argv[1]
rng = np.random.default_rng(5)
picture = np.full((90, 121), 90, np.uint8)
cv2.rectangle(picture, (20, 15), (70, 60), 160, -1)
cv2.ellipse(picture, (85, 55), (25, 14), 30, 0, 360, 40, -1)
cv2.line(picture, (3, 85), (118, 4), 210, 2)
picture = cv2.GaussianBlur(picture, (3, 3), 0.7)
picture = np.clip(picture + rng.normal(0, 9, picture.shape), 0, 255).astype(np.uint8)
cv2.imwrite(f"{folder}/canny_input.png", picture)
for low, high in ((40, 100), (90, 200)):
    cv2.imwrite(f"{folder}/canny_{low}_{high}.png", cv2.Canny(picture, low, high))
