#!/usr/bin/env bash
# The tag radio on a real kernel in an emulated machine: through bluetoothd, and by our own Bluetooth
# host on the kernel's user channel. The machine's controller is ours, on a serial line over TCP, with
# virtual tags on its air.
#
#     scripts/qemu_bluez.sh
#
# Needs Debian (or a relative with the package linux-image-amd64); as root it installs what is
# missing, else it says what is. About a minute, four at most, and what the build takes. Skips with a
# message where it cannot run.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/qemu_guest.sh

daemon=/usr/libexec/bluetooth/bluetoothd
guest_need qemu-system-x86_64=qemu-system-x86 busybox=busybox-static cpio=cpio pkg-config=pkg-config \
  "$daemon=bluez" dbus-daemon=dbus /usr/include/dbus-1.0/dbus/dbus.h=libdbus-1-dev
guest_kernel
cargo build -q --locked -p vergence-link --example tag_server
cargo build -q --locked -p vergence-link --features bluez --example bluez_probe
guest_files "$guest/bluez" hmac sha512_generic ctr ecb cmac jitterentropy_rng drbg ecdh_generic \
  algif_hash algif_skcipher hci_uart -- \
  "$daemon" btattach btmgmt dbus-daemon target/debug/examples/bluez_probe

tags=$(mktemp)
target/debug/examples/tag_server 127.0.0.1:0 >"$tags" &
server=$!
trap 'kill $server; rm -f "$tags"' EXIT
until grep -q 'tags on' "$tags"; do sleep 0.1; done
port=$(sed -n 's/tags on .*:\([0-9]*\)$/\1/p' "$tags")

guest_run "$guest/bluez" 260 -chardev "socket,id=hci,host=127.0.0.1,port=$port,nodelay=on" \
  -serial chardev:hci <<'INIT'
# The kernel pairs with these. The order matters: each tests itself with those before it.
for module in hmac sha512_generic ctr ecb cmac jitterentropy_rng drbg ecdh_generic algif_hash \
  algif_skcipher hci_uart; do
  modprobe $module 2>/dev/null
done
echo 'root:x:0:0:root:/:/bin/sh' >/etc/passwd
mkdir -p /run/dbus /var/lib/bluetooth
cat >/etc/dbus.conf <<CONF
<busconfig>
  <type>system</type>
  <listen>unix:path=/run/dbus/system_bus_socket</listen>
  <auth>EXTERNAL</auth>
  <policy context="default">
    <allow user="*"/> <allow own="*"/> <allow send_destination="*" eavesdrop="true"/> <allow eavesdrop="true"/>
  </policy>
</busconfig>
CONF
dbus-daemon --config-file=/etc/dbus.conf --nopidfile --fork
btattach -B /dev/ttyS1 -P h4 >/dev/null 2>&1 &
bluetoothd -n >/run/bluetoothd.log 2>&1 &
for second in 1 2 3 4 5 6 7 8 9 10; do
  [ -e /sys/class/bluetooth/hci0 ] && break
  sleep 1
done
sleep 2
echo "# BlueZ $(bluetoothd --version)"
if timeout 160 bluez_probe bluez; then result=passed; else result=failed; cat /run/bluetoothd.log; fi
kill $(pidof bluetoothd)
sleep 1
btmgmt --index 0 power off >/dev/null 2>&1 </dev/null
echo '# our own host on the user channel'
timeout 70 bluez_probe hci0 || result=failed
echo "guest: $result"
INIT
