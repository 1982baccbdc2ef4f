#!/usr/bin/env bash
# Measures and trains on a machine with an NVIDIA GPU: driml doctor, parity and speed on the device, PyTorch on the same
# device, then whole runs for so many minutes each. A call with the same --out skips finished steps and resumes
# an interrupted run from its newest checkpoint, for the remaining minutes.

set -euo pipefail
unset CDPATH
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/../.." && pwd)

say() { printf '=== %s\n' "$*"; }
fail() { printf 'error: %s\n' "$*" >&2; exit 1; }

usage() {
    cat <<'TEXT'
Usage: deploy/cuda/measure.sh [--out DIR] [--minutes N] [--seed S] [--device cuda:N] [--python PYTHON]

  --out DIR        where results go [default: runs/cuda]
  --minutes N      how long each of the six runs trains (bigfish, starpilot; c51, driml-fix, driml-ada) [default: 60]
  --seed S         seed of the runs [default: 1]
  --device cuda:N  the device [default: cuda]
  --python PYTHON  a Python with PyTorch for CUDA: its update is measured on the same device, eager and compiled

It needs a `target/release/driml` with CUDA: cargo build --release --features cuda, or deploy/cuda/build.sh.
TEXT
}

out=runs/cuda minutes=60 seed=1 device=cuda python=
while [ $# -gt 0 ]; do
    [ $# -gt 1 ] || { usage >&2; [[ $1 = -h || $1 = --help ]] && exit 0; exit 64; }
    case $1 in
        --out) out=$2 ;;
        --minutes) minutes=$2 ;;
        --seed) seed=$2 ;;
        --device) device=$2 ;;
        --python) python=$2 ;;
        *) usage >&2; exit 64 ;;
    esac
    shift 2
done
[[ $minutes =~ ^[1-9][0-9]*$ ]] || fail "--minutes takes a whole number above 0, not \"$minutes\""
[[ $device =~ ^cuda(:[0-9]+)?$ ]] || fail "--device takes cuda or cuda:N, not \"$device\""

# --- What it needs -------------------------------------------------------------------------------------------------------

compgen -G '/proc/driver/nvidia/gpus/*/information' >/dev/null || [ -e /dev/nvidiactl ] || [ -e /dev/dxg ] ||
    fail "there is no NVIDIA GPU here (neither /proc/driver/nvidia/gpus nor /dev/nvidiactl): nothing to measure.
  In a container, give it the GPU (docker run --gpus all)."
driml=$(realpath -m "${CARGO_TARGET_DIR:-$root/target}")/release/driml
[ -x "$driml" ] || fail "there is no $driml: cargo build --release --features cuda, or without a CUDA toolkit
  deploy/cuda/build.sh --compute-cap N, with the GPU's compute capability"

mkdir -p "$out"
out=$(cd "$out" && pwd)
# One at a time in a folder: two would move each other's runs aside.
exec 9>"$out/.lock"
flock -n 9 || fail "another measurement writes to $out"

# Results of other settings or another program are not mixed with these.
made_with="device $device, $minutes min a run, seed $seed, driml $(sha256sum "$driml" | cut -c1-16)"
[ -f "$out/made-with.txt" ] || printf '%s\n' "$made_with" >"$out/made-with.txt"
[ "$(cat "$out/made-with.txt")" = "$made_with" ] || fail "$out has results of: $(cat "$out/made-with.txt")
  This call would make: $made_with. Choose another --out."

# --- The steps -----------------------------------------------------------------------------------------------------------

failed=()
# Runs the step $1, its output in $1.txt, unless it is done. A step that fails is told at the end; the others go on.
step() {
    local name=$1
    shift
    [ ! -f "$out/$name.done" ] || { say "$name: done before"; return 0; }
    say "$name: $*"
    # -i: after Ctrl-C the program still says how it ended.
    if "$@" > >(tee -i "$out/$name.txt") 2>&1; then
        touch "$out/$name.done"
    else
        failed+=("$name")
        say "$name FAILED: see $out/$name.txt"
    fi
}

# One whole run of game $1 and agent $2, ended as by Ctrl-C when its time is over: then it saves and writes its summary.
train() {
    local game=$1 agent=$2 folder code=0 spent=0 what
    folder=$out/runs/$game-$agent-$seed
    # The time ends it: more frames than any GPU learns from in that time. The residual torso is slow on GPUs.
    what=(--env "procgen:$game" --agent "$agent" --seed "$seed" --frames 1000000000 --set model.torso=nature --run-dir "$folder")
    if compgen -G "$folder/checkpoints/checkpoint-*[0-9]" >/dev/null; then
        what=(--resume "$folder")
        # The first column of its last row, in whole seconds; none if there is only the header.
        spent=$(tail -n 1 "$folder/metrics.csv" | sed -En 's/^([0-9]+)\.[0-9]+,.*/\1/p')
    elif [ -e "$folder" ]; then
        mkdir -p "$out/cut-off"
        mv "$folder" "$out/cut-off/$(basename "$folder")-$(date +%s)"
    fi
    local left=$((minutes * 60 - ${spent:-0}))
    [ "$left" -ge 60 ] || left=60
    timeout --foreground --signal=INT --kill-after=300 "${left}s" "$driml" local "${what[@]}" --device "$device" || code=$?
    # 124: the time was over. 130 is a person's Ctrl-C, after which the same call goes on with the run.
    [ "$code" = 0 ] || [ "$code" = 124 ] || return "$code"
    [ -f "$folder/summary.json" ]
}

trap 'say "interrupted; the same call goes on from here"; exit 130' INT
# First, and each time, as the machine may have changed.
"$driml" doctor --cuda --run-dir "$out" | tee "$out/doctor.txt" || fail "driml doctor says above what is missing"

step parity "$driml" parity "$root"/tests/parity/*.safetensors --device "$device"
step learner "$driml" bench learner --device "$device" --json "$out/learner.json"
if [ -n "$python" ]; then
    if "$python" -c 'import sys, torch; sys.exit(not torch.cuda.is_available())'; then
        torch_update() { PYTHONPATH=$root/deploy/python${PYTHONPATH:+:$PYTHONPATH} "$python" "$root/deploy/bench/peers/torch_update.py" --device "$device" "$@"; }
        step torch-parity torch_update --check "$root"/tests/parity/*.safetensors
        step torch-eager torch_update
        step torch-compiled torch_update --compile
    else
        failed+=(torch)
        say "$python has no PyTorch that can use this GPU: its steps are skipped"
    fi
fi
for agent in driml-ada driml-fix c51; do
    for game in bigfish starpilot; do
        step "$game-$agent-$seed" train "$game" "$agent"
    done
done
[ ! -d "$out/runs" ] || "$driml" plot "$out"/runs/* --smooth 10000 --out "$out/returns.svg" || failed+=(plot)

[ ${#failed[@]} = 0 ] || fail "these failed, the same call tries them again: ${failed[*]}"
say "all is in $out"
