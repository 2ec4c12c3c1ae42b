#!/usr/bin/env python3
"""Our MJPEG driver against an independent server: Python's http.server and Pillow's JPEG encoder.

    cargo build -p vergence-devices --example mjpeg_probe
    python3 scripts/check_mjpeg.py target/debug/examples/mjpeg_probe

Serves the same pictures in three manners: as network cameras do (with lengths and time stamps), as
simple ones do (neither), and with a connection that breaks in the middle of a picture. Exit status 0
when every picture arrives in order and with its brightness.
"""

import collections
import io
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from PIL import Image

SIZE = (96, 64)
PICTURES = 12
PERIOD = 0.05
BOUNDARY = "aCameraBoundary"


def picture(i):
    """The i-th picture: its brightness tells its number."""
    out = io.BytesIO()
    Image.new("RGB", SIZE, (20 * i, 20 * i, 20 * i)).save(out, "JPEG", quality=92)
    return out.getvalue()


class Camera(BaseHTTPRequestHandler):
    # Pictures sent in each manner: an earlier client's connection may outlive it by a picture or two.
    sent = collections.Counter()

    def do_GET(self):
        manner = self.path.strip("/")
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.end_headers()
        try:
            while True:
                i = Camera.sent[manner] % PICTURES
                body = picture(i)
                self.wfile.write(f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\n".encode())
                if manner != "plain":
                    self.wfile.write(f"Content-Length: {len(body)}\r\n".encode())
                    self.wfile.write(f"X-Timestamp: {5000 + Camera.sent[manner] * PERIOD:.6f}\r\n".encode())
                if manner == "broken" and Camera.sent[manner] == 4:
                    Camera.sent[manner] += 1
                    self.wfile.write(b"\r\n" + body[: len(body) // 2])
                    self.wfile.flush()
                    return
                self.wfile.write(b"\r\n" + body + b"\r\n")
                Camera.sent[manner] += 1
                # An uneven network: the time stamps are even, the arrivals are not.
                time.sleep(PERIOD * (0.6 if Camera.sent[manner] % 2 else 1.4))
        except (BrokenPipeError, ConnectionResetError):
            pass

    def log_message(self, *_):
        pass


def probe(program, port, manner):
    url = f"http://127.0.0.1:{port}/{manner}"
    command = [program, url, str(SIZE[0]), str(SIZE[1]), str(PICTURES - 1)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    if done.returncode != 0:
        sys.exit(f"FAILED {manner}: {done.stderr}")
    rows = [tuple(map(float, line.split())) for line in done.stdout.splitlines()]
    numbers = [round(mean / 20) for _, _, mean in rows]
    wanted = [n for n in range(PICTURES) if not (manner == "broken" and n == 4)][: len(rows)]
    if numbers != wanted:
        sys.exit(f"FAILED {manner}: pictures {numbers}, wanted {wanted}")
    if [int(s) for s, _, _ in rows] != list(range(len(rows))):
        sys.exit(f"FAILED {manner}: sequence {[s for s, _, _ in rows]}")
    return [stamp for _, stamp, _ in rows]


def main():
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    server = ThreadingHTTPServer(("127.0.0.1", 0), Camera)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    port = server.server_address[1]
    stamps = probe(sys.argv[1], port, "timed")
    # After the first few pictures the smallest delay is known, and stamps are as even as the camera's.
    steps = [b - a for a, b in zip(stamps[4:], stamps[5:])]
    if not all(abs(step - PERIOD) < 0.01 for step in steps):
        sys.exit(f"FAILED timed: steps {steps}")
    probe(sys.argv[1], port, "plain")
    probe(sys.argv[1], port, "broken")
    server.shutdown()
    print("MJPEG driver: three manners of an independent server are understood")


if __name__ == "__main__":
    main()
