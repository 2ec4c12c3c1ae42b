# A virtual machine with Debian's kernel and a handful of programs, for scripts that source this file.
#
# The machine is emulated (no KVM is needed), has no disk and no network: programs, the libraries that
# they need and the kernel modules come in its initial file system, results go out on its console.
# All of it lies in target/qemu.

guest=target/qemu

# Ends the script without failing it: the machine it runs on cannot do this check.
skip() {
  echo "SKIPPED: $*"
  exit 0
}

# guest_need PROGRAM=PACKAGE ...: the programs are there, or are installed if we may.
guest_need() {
  local missing=()
  for pair in "$@"; do
    command -v "${pair%%=*}" >/dev/null || [ -e "${pair%%=*}" ] || missing+=("${pair#*=}")
  done
  if [ ${#missing[@]} -gt 0 ]; then
    command -v apt-get >/dev/null || skip "needs ${missing[*]}, and this system has no apt"
    [ "$(id -u)" = 0 ] || skip "needs the packages ${missing[*]}; install them and try again"
    apt-get update -qq >/dev/null || skip "the package lists cannot be had"
    DEBIAN_FRONTEND=noninteractive timeout 240 apt-get install -qq -y --no-install-recommends \
      "${missing[@]}" >/dev/null 2>&1 || skip "the packages ${missing[*]} cannot be installed"
  fi
}

# guest_kernel: Debian's kernel, unpacked, not installed; sets $kernel (its version).
guest_kernel() {
  local package
  package=$(apt-cache depends linux-image-amd64 2>/dev/null |
    sed -n 's/.*Depends: \(linux-image-[0-9]\S*\)$/\1/p' | head -1)
  [ -n "$package" ] || skip "the package linux-image-amd64 is not known here"
  kernel=${package#linux-image-}
  if [ ! -e "$guest/kernel/boot/vmlinuz-$kernel" ]; then
    rm -rf "$guest/kernel"
    mkdir -p "$guest/kernel"
    (cd "$guest/kernel" && timeout 240 apt-get download -qq "$package" 2>/dev/null) ||
      skip "$package cannot be downloaded"
    dpkg-deb -x "$guest"/kernel/linux-image-*.deb "$guest/kernel"
    rm "$guest"/kernel/linux-image-*.deb
    # Newer packages keep everything below /usr.
    [ -e "$guest/kernel/lib" ] || ln -s usr/lib "$guest/kernel/lib"
    busybox depmod -b "$guest/kernel" "$kernel" 2>/dev/null
  fi
}

# guest_files ROOT MODULE... -- PROGRAM...: an initial file system with these modules (and those that
# they need) and these programs (and their libraries).
guest_files() {
  local root=$1 modules=$guest/kernel/lib/modules/$kernel file
  shift
  rm -rf "$root"
  mkdir -p "$root"/{bin,dev,proc,sys,run,tmp,etc,var} "$root/lib/modules/$kernel"
  ln -s /run "$root/var/run"
  cp "$(command -v busybox)" "$root/bin/busybox"
  while [ "$1" != -- ]; do
    # modules.dep: "path/of/module.ko: what it needs ..."
    for file in $(sed -n "s#^\(\S*/$1\.ko[.a-z]*\):\(.*\)#\1 \2#p" "$modules/modules.dep"); do
      install -D -m 644 "$modules/$file" "$root/lib/modules/$kernel/$file"
    done
    shift
  done
  shift
  busybox depmod -b "$root" "$kernel" 2>/dev/null
  for program in "$@"; do
    file=$(command -v "$program")
    # Debug information would fill the guest's memory.
    install -D "$file" "$root/bin/${file##*/}"
    strip "$root/bin/${file##*/}" 2>/dev/null || true
    for library in $(ldd "$file" | grep -o '/\S*'); do
      [ -e "$root$library" ] || install -D "$library" "$root$library"
    done
  done
}

# guest_run ROOT SECONDS QEMU-OPTION...: boots it, prints what it writes to its console after the line
# "guest: begin", and succeeds when the last line of that is "guest: passed". The guest's /init has
# $guest_prelude before the script that comes on standard input.
guest_run() {
  local root=$1 limit=$2 log=$1.log begin=$SECONDS
  shift 2
  { echo "$guest_prelude"; cat; } >"$root/init"
  chmod +x "$root/init"
  (cd "$root" && find . | cpio -o -H newc -R 0:0 --quiet) | gzip -1 >"$root.cpio.gz"
  timeout "$limit" qemu-system-x86_64 -accel tcg -cpu max -m 768 -nodefaults -display none \
    -no-reboot -kernel "$guest/kernel/boot/vmlinuz-$kernel" -initrd "$root.cpio.gz" \
    -append "console=ttyS0 loglevel=1 no_timer_check panic=-1 mitigations=off rdinit=/init" \
    -serial stdio "$@" </dev/null >"$log" 2>&1 || echo "the machine was stopped after $limit s" >>"$log"
  tr -d '\r' <"$log" | sed '0,/^guest: begin$/d; /reboot: Power down$/d' >"$log.clean"
  if ! grep -q . "$log.clean"; then
    tail -30 "$log"
  fi
  cat "$log.clean"
  echo "kernel $kernel, $((SECONDS - begin)) s"
  [ "$(grep '^guest: ' "$log.clean" | tail -1)" = 'guest: passed' ]
}

# Mounts what every program expects, and ends the machine whatever the script after it does.
guest_prelude='#!/bin/busybox sh
export PATH=/bin
/bin/busybox --install -s /bin
mount -t devtmpfs none /dev
mount -t proc none /proc
mount -t sysfs none /sys
mount -t tmpfs none /run
mount -t tmpfs none /tmp
ifconfig lo up 2>/dev/null
trap "sync; poweroff -f" EXIT
echo "guest: begin"'
