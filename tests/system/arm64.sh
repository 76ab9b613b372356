#!/bin/sh
# Computes on arm64, emulated by qemu-user, what this machine computes, too, and compares every bit:
#
#     sh tests/system/arm64.sh [FOLDER]
#
# 1. the checks of `python -m tests.system.bits`: golden records, missions of every policy, recovery, batches, figures, the world's draws;
#    on a Cortex-A53, and on a processor with all that qemu knows, SVE among it, which the rest is computed on, too;
# 2. `plumeward rollout` of a policy family each, by its JSON with the trace;
# 3. `plumeward fly`, all parts over Zenoh: one mission, and one in which estimator and agent are killed and started again;
# 4. `plumeward replay --verify`: here of a mission that was flown on arm64, and there of one that was flown here.
#
# It prints a line for each, then how many are the same; the status is 0 if all are. What was computed stays in FOLDER/here and
# FOLDER/arm64. FOLDER (default: /tmp/plumeward-arm64) also keeps the arm64 system that the first run makes there with debootstrap; a
# flight's packages come as wheels for arm64. Mirror and index are those that apt and pip are set to use.
#
# Needs root, on Debian for amd64, and `make setup`; also `apt-get install qemu-user-static debootstrap`. It takes 20 minutes the first
# time, ten later. What only tests and training need is not installed there.
set -eu

checkout=$(cd "$(dirname "$0")/../.." && pwd)
folder=${1:-/tmp/plumeward-arm64}
python=$checkout/.venv/bin/python
binfmt=/proc/sys/fs/binfmt_misc

if [ "$(id -u)" != 0 ] || ! command -v debootstrap >/dev/null || ! [ -e /usr/lib/binfmt.d/qemu-aarch64.conf ] || ! [ -x "$python" ]; then
    echo "wanted: root, \`make setup\` and \`apt-get install qemu-user-static debootstrap\`" >&2
    exit 2
fi
if [ -z "${PLUMEWARD_UNSHARED:-}" ]; then # what is mounted here ends with the script
    PLUMEWARD_UNSHARED=1 exec unshare --mount --propagation private sh "$0" "$@"
fi
mkdir -p "$folder"
folder=$(cd "$folder" && pwd)
root=$folder/root

# ---- an arm64 system ----
[ -e $binfmt/register ] || mount -t binfmt_misc binfmt_misc $binfmt
[ -e $binfmt/qemu-aarch64 ] || cat /usr/lib/binfmt.d/qemu-aarch64.conf >$binfmt/register
if ! [ -e "$folder/made" ]; then
    rm -rf "$root"
    suite=$(. /etc/os-release && echo "$VERSION_CODENAME")
    mirror=$(apt-get indextargets --format '$(REPO_URI)' 'Created-By: Packages' 'Component: main' | grep -v security | head -n 1)
    debootstrap --arch=arm64 --variant=minbase --include=python3 "$suite" "$root" "$mirror" >"$folder/debootstrap.log"
    touch "$folder/made"
fi
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"

# ---- a flight's packages, and the checkout ----
version=$(chroot "$root" python3 -c 'import sys; print("%d.%d" % sys.version_info[:2])')
"$python" - "$checkout/pyproject.toml" >"$folder/packages.txt" <<'EOF'
import sys, tomllib
from pathlib import Path
print(*tomllib.loads(Path(sys.argv[1]).read_text())["project"]["dependencies"], sep="\n")
EOF
if ! cat "$folder/packages.txt" "$checkout/constraints.txt" | cmp -s - "$folder/installed.txt"; then
    rm -rf "$root/opt/packages" # glibc, from the newest that wheels are made for to the oldest
    "$python" -m pip install -q --target "$root/opt/packages" --python-version "$version" --only-binary=:all: \
        $(for glibc in 35 34 31 28 27 26 24 17; do echo "--platform manylinux_2_${glibc}_aarch64"; done) --platform manylinux2014_aarch64 \
        -c "$checkout/constraints.txt" -r "$folder/packages.txt" 2>"$folder/pip.log" || { cat "$folder/pip.log" >&2; exit 2; }
    cat "$folder/packages.txt" "$checkout/constraints.txt" >"$folder/installed.txt"
fi
copy=$root/opt/plumeward # both sides compute with it: nothing changes under them
rm -rf "$copy" "$folder/here" "$root/opt/arm64"
mkdir -p "$copy" "$folder/here" "$root/opt/arm64" "$root/opt/kernels"
ln -sfn root/opt/arm64 "$folder/arm64"
(cd "$checkout" && git ls-files -z --cached --others --exclude-standard | tar -c --null -T - --ignore-failed-read) | tar -x -C "$copy"

# ---- both sides ----
here() { # NAME COMMAND...: run Python here; what it prints goes to here/NAME
    name=$1 && shift
    (cd "$folder/here" && PYTHONPATH=$copy "$python" "$@" >"$name" 2>"$name.err")
}
arm64() { # NAME COMMAND...: run Python there; what it prints goes to arm64/NAME
    name=$1 && shift
    chroot "$root" env -i QEMU_CPU="$processor" PATH=/usr/bin:/bin HOME=/root LANG=C.UTF-8 \
        PYTHONPATH=/opt/plumeward:/opt/packages NUMBA_CACHE_DIR=/opt/kernels \
        sh -c 'cd /opt/arm64 && exec python3 "$@"' sh "$@" >"$folder/arm64/$name" 2>"$folder/arm64/$name.err"
}
said() { # NAME RESULT...: one line of the report
    echo "$*" | tee -a "$folder/said"
}
both() { # NAME COMMAND...: run it on both sides, and compare what they print, but for the time that a search took
    for side in here arm64; do
        $side "$@" || echo "failed: $(tail -n 1 "$folder/$side/$1.err")" >>"$folder/$side/$1"
        sed -i 's/"search_time_s":[^,]*,//' "$folder/$side/$1"
    done
    if ! grep -q '^{.*trace' "$folder/here/$1"; then
        said "$1" "DIFFERS: it has no trace here"
    elif cmp "$folder/here/$1" "$folder/arm64/$1"; then
        said "$1" same
    else
        said "$1" DIFFERS
    fi
}
verified() { # SIDE RECORD: replay a record of the other side
    cp "$2" "$folder/$1/other.mcap"
    if $1 verify -m plumeward replay other.mcap --verify --speedup 0; then
        said "replayed-$1" same
    else
        said "replayed-$1" "DIFFERS: $(tail -n 1 "$folder/$1/verify.err")"
    fi
}
: >"$folder/said"
echo "here:  $("$python" --version), $(ldd --version | head -n 1)"
echo "arm64: $(chroot "$root" python3 --version), $(chroot "$root" ldd --version | head -n 1)"

timed() { # SIDE NAME: the checks of one side
    began=$(date +%s)
    $1 "$2" -m tests.system.bits || said "$2" "DIFFERS: it failed: $(tail -n 1 "$folder/$1/$2.err")"
    echo "$2 took $(($(date +%s) - began)) s, compiling included"
}
timed here bits
for processor in cortex-a53 max; do
    timed arm64 "$processor"
    while read -r check digest; do
        there=$(sed -n "s|^$check ||p" "$folder/arm64/$processor")
        case $digest in
            *DIFFERS*) said "$processor/$check" "DIFFERS here, too: $digest" ;;
            "$there") said "$processor/$check" same ;;
            *) said "$processor/$check" "DIFFERS: here $digest, there $there" ;;
        esac
    done <"$folder/here/bits"
done

for policy in homing infotaxis thompson ppo dqn ddpg; do
    both "rollout-$policy" -m plumeward rollout --policy "$policy" --seed 11 --budget 40 --json --trace
done
both fly -m plumeward fly --seed 11 --budget 12 --speedup 0 --record flown.mcap --json --trace
both fly-killed -m plumeward fly crashing-services --speedup 0 --no-record --json --trace
verified here "$folder/arm64/flown.mcap"
verified arm64 "$folder/here/flown.mcap"

echo "$(grep -c ' same$' "$folder/said") of $(wc -l <"$folder/said") are the same on arm64"
! grep -q DIFFERS "$folder/said"
