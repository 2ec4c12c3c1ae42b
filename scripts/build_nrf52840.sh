#!/usr/bin/env bash
# Compiles the smart tag for the Nordic nRF52840 and tells how large it is; before that the firmware
# core alone, which shows that it needs neither an operating system nor a heap.
#
# Needs the Rust target thumbv7em-none-eabihf (rustup adds it) and libclang with its headers (Debian:
# libclang-dev). Where they cannot be had, it says so and ends well: nothing was checked then.
set -euo pipefail
cd "$(dirname "$0")/.."
target=thumbv7em-none-eabihf
export CARGO_TARGET_DIR=$PWD/target/$target

skip() { echo "SKIPPED, not checked: $1"; exit 0; }

has_target() { [ -d "$(rustc --print target-libdir --target $target)" ]; }
has_target || rustup target add $target || true
has_target || skip "the Rust target $target cannot be had"

# The folder of a libclang that finds its own headers.
find_libclang() {
  for folder in ${LIBCLANG_PATH:-} /usr/lib/llvm-*/lib; do
    if compgen -G "$folder/libclang*.so*" >/dev/null \
      && compgen -G "$folder/clang/*/include/stdint.h" >/dev/null; then
      echo "$folder"
      return
    fi
  done
}
if [ -z "$(find_libclang)" ] && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
  apt-get update -qq || true
  apt-get install -y -qq --no-install-recommends libclang-dev >/dev/null || true
fi
LIBCLANG_PATH=$(find_libclang)
[ -n "$LIBCLANG_PATH" ] || skip 'libclang with its headers cannot be had (Debian: libclang-dev)'
export LIBCLANG_PATH

echo '--- firmware core without std'
cargo build -q --locked --release -p vergence-firmware --target $target

echo '--- nRF52840'
cd firmware/nrf52840
cargo fmt -- --check
cargo clippy -q --locked --release -- -D warnings
cargo build -q --locked --release
python3 - "$CARGO_TARGET_DIR/$target/release/tag" <<'PYTHON'
import struct
import sys

# Sums the sections of a 32-bit ELF file that are loaded: flash holds code and initial values, RAM the
# writable ones.
image = open(sys.argv[1], "rb").read()
(start,) = struct.unpack_from("<I", image, 32)
entry, count = struct.unpack_from("<HH", image, 46)
flash = ram = 0
for k in range(count):
    _, kind, flags, _, _, size = struct.unpack_from("<6I", image, start + k * entry)
    if flags & 2:
        flash += size if kind != 8 else 0
        ram += size if flags & 1 else 0
print(f"flash {flash / 1024:.0f} KiB of 1008, RAM {ram / 1024:.0f} KiB of 256 (without the stack)")
if flash < 50_000:
    sys.exit("that is too little to be a tag: the linker has dropped it")
PYTHON
