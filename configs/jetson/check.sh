#!/bin/sh
# What a Jetson Nano still lacks to fly, each with its remedy. How it all gets there: docs/jetson.md.
#   sudo sh configs/jetson/check.sh [FOLDER]     FOLDER: look at another root than / (a mounted card; a test)
# Exit code: 0 nothing lacks, 1 something does, 2 wrong arguments.
set -u

root=${1:-}
root=${root%/}
if [ $# -gt 1 ] || { [ -n "$root" ] && [ ! -d "$root" ]; }; then
    echo "usage: sh check.sh [FOLDER]; no such folder: $*" >&2
    exit 2
fi
configs=$(cd "$(dirname "$0")/.." && pwd) || exit 2
lacking=0

# check WHAT REMEDY COMMAND...: tell whether the command succeeds.
check() {
    what=$1 remedy=$2
    shift 2
    if "$@" >/dev/null 2>&1; then
        echo "ok       $what"
    else
        echo "LACKING  $what"
        echo "         $remedy"
        lacking=$((lacking + 1))
    fi
}
# holds FILE WORDS: the file has these words in it.
holds() { grep -qs -- "$2" "$root$1"; }
here() { [ -e "$root$1" ] || [ -L "$root$1" ]; }
absent() { ! here "$1"; }
same() { cmp -s "$configs/$1" "$root$2"; }
at_most() { [ "$(cat "$root$1")" -le "$2" ]; }
# Each of these files is in the folder.
holds_all() {
    folder=$1
    shift
    for file; do here "$folder/$file" || return; done
}
# The folder and all in it are the service's own, and nobody else may read its private key. (No user yet: told above.)
own() {
    user=$(sed -n 's/^pipewright:[^:]*:\([0-9]*\):.*/\1/p' "$root/etc/passwd")
    here "$1" && [ -z "$(find "$root$1" ! -uid "${user:-0}" ${user:+-print} -o -name key.pem -perm /077 -print)" ]
}
# A file of this name pattern, below a folder.
found() { [ -n "$(find "$root$1" -name "$2" -print 2>/dev/null | head -n 1)" ]; }

# Where the program is: on JetPack 4.6 in a Debian root of its own, on Debian 12 in the machine's.
inner=/srv/pipewright
if holds /etc/debian_version '^12'; then inner=; fi

echo "-- the machine"
if [ -n "$inner" ]; then
    check "JetPack 4.6 (L4T R32.6 or R32.7)" "write NVIDIA's image of JetPack 4.6 to the card" \
        grep -Eq '^# R32 .*REVISION: [67]' "$root/etc/nv_tegra_release"
    check "no console on the UART (nvgetty)" "sudo systemctl disable --now nvgetty, then restart" \
        absent /etc/systemd/system/multi-user.target.wants/nvgetty.service
    check "power mode MAXN" "sudo nvpmodel -m 0" holds /var/lib/nvpmodel/status 'pmode:0000'
fi
check "all four processors at work" "sudo nvpmodel -m 0: the mode of 5 W has two of them asleep" \
    holds /sys/devices/system/cpu/online '^0-3$'
check "full clock at once" "sudo jetson_clocks, or: echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor" \
    holds /sys/devices/system/cpu/cpu0/cpufreq/scaling_governor '^performance$'

echo "-- the devices"
for rules in servos t265 pixhawk; do
    check "udev rules: 99-$rules.rules" \
        "sudo cp $configs/udev/*.rules /etc/udev/rules.d/ && sudo udevadm control --reload && sudo udevadm trigger" \
        same "udev/99-$rules.rules" "/etc/udev/rules.d/99-$rules.rules"
done
check "/dev/autopilot" "the UART of the header must be on (ls /dev/ttyTHS1), its rule installed" here /dev/autopilot
check "/dev/t265" "plug the camera into a blue port itself; after a warm start, pull it out and in again" here /dev/t265
check "/dev/servos" "plug in the U2D2, and give the servos their 5 V" here /dev/servos
if here /dev/servos; then
    tty=$(readlink "$root/dev/servos")
    timer=/sys/bus/usb-serial/devices/${tty##*/}/latency_timer
    check "latency timer of the U2D2: 1 ms" "pull it out and in again, so that its rule acts; or: echo 1 | sudo tee $timer" \
        at_most "$timer" 1
fi

echo "-- the program, in ${inner:-/}"
if [ -n "$inner" ]; then
    check "a Debian 12 root" "sudo debootstrap --arch=arm64 bookworm $inner http://deb.debian.org/debian" \
        holds "$inner/etc/debian_version" '^12'
fi
check "Python 3.11" "there: apt install python3 python3-venv" here "$inner/usr/bin/python3.11"
check "Pipewright" "there: see docs/jetson.md, The program" here "$inner/opt/pipewright/.venv/bin/pipewright"
check "librealsense 2.53.1, the last one that knows the T265" "there: see docs/jetson.md, The camera's library" \
    here "$inner/usr/local/lib/librealsense2.so.2.53.1"
check "its Python binding" "there: see docs/jetson.md, The camera's library" \
    found "$inner/opt/pipewright/.venv/lib" 'pyrealsense2*.so*'

echo "-- the service"
check "its user" "sudo cp $configs/systemd/pipewright.sysusers /etc/sysusers.d/pipewright.conf && sudo systemd-sysusers" \
    holds /etc/passwd '^pipewright:'
check "its unit" "sudo cp $configs/systemd/pipewright.service /etc/systemd/system/ && sudo systemctl daemon-reload" \
    same systemd/pipewright.service /etc/systemd/system/pipewright.service
if [ -n "$inner" ]; then
    check "its root (jetpack.conf)" \
        "sudo install -D $configs/jetson/jetpack.conf /etc/systemd/system/pipewright.service.d/jetpack.conf && sudo systemctl daemon-reload" \
        same jetson/jetpack.conf /etc/systemd/system/pipewright.service.d/jetpack.conf
fi
check "its beginning with the machine" "sudo systemctl enable pipewright" \
    here /etc/systemd/system/multi-user.target.wants/pipewright.service
check "a journal that outlives the battery" \
    "sudo install -D $configs/systemd/journald.conf /etc/systemd/journald.conf.d/pipewright.conf && sudo systemctl restart systemd-journald" \
    same systemd/journald.conf /etc/systemd/journald.conf.d/pipewright.conf
check "the vehicle's configuration" "see docs/jetson.md, The service; then what was measured: docs/devices.md" \
    here /etc/pipewright/vehicle.yaml
check "the vehicle's keys" "ca.pem, cert.pem, key.pem and roster.json into /etc/pipewright/keys: docs/keys.md, What goes where" \
    holds_all /etc/pipewright/keys ca.pem cert.pem key.pem roster.json
check "keys that the service may read, and nobody else" \
    "sudo chown -R pipewright: /etc/pipewright/keys && sudo chmod -R u=rwX,go= /etc/pipewright/keys" own /etc/pipewright/keys

if [ "$lacking" -eq 0 ]; then
    echo "nothing lacks"
    exit 0
fi
echo "$lacking lacking"
exit 1
