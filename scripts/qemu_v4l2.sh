#!/usr/bin/env bash
# The driver `v4l2` against the kernel's test camera (vivid) on a real kernel in an emulated machine.
#
#     scripts/qemu_v4l2.sh
#
# Needs Debian (or a relative with the package linux-image-amd64); as root it installs what is
# missing, else it says what is. Half a minute, two at most, and what the build takes. Skips with a
# message where it cannot run.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/qemu_guest.sh

guest_need qemu-system-x86_64=qemu-system-x86 busybox=busybox-static cpio=cpio v4l2-ctl=v4l-utils
guest_kernel
cargo build -q --locked -p vergence-devices --example v4l2_probe
guest_files "$guest/v4l2" vivid -- v4l2-ctl target/debug/examples/v4l2_probe
guest_run "$guest/v4l2" 120 <<'INIT'
# One camera of the kind "webcam" with a picture that stands still, stamped at the start of exposure.
modprobe vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=0x0
v4l2-ctl -d /dev/video0 --set-ctrl osd_text_mode=2,test_pattern=0,timestamp_source=1
if timeout 100 v4l2_probe /dev/video0; then echo 'guest: passed'; else echo 'guest: failed'; fi
INIT
