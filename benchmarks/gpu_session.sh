#!/usr/bin/env bash
# Everything that this project measures on a GPU, in at most eight minutes, into one file:
#
#     benchmarks/gpu_session.sh gpu.md
#
# Each part has its own time limit, and one that fails or runs out of time does not stop the others.
# PYTHON names the interpreter; on a machine without a network, wheels of missing packages are taken
# from the folder that WHEELS names. To try the script without a GPU (Warp's CPU device, a minute):
#
#     DEVICE=cpu benchmarks/gpu_session.sh /tmp/gpu.md
set -uo pipefail
file=$(realpath -m "${1:?usage: benchmarks/gpu_session.sh FILE}")
cd "$(dirname "$0")/.."
python=${PYTHON:-python3} device=${DEVICE:-cuda} runs=$(mktemp -d)
trap 'rm -rf "$runs"' EXIT
mkdir -p "$(dirname "$file")"

if [ -n "${WHEELS:-}" ]; then "$python" -m pip install -q --no-index --find-links "$WHEELS" "$WHEELS"/*.whl; fi
export PYTHONPATH=$PWD

part() {  # title, seconds, command...
    local title=$1 limit=$2 start=$SECONDS
    shift 2
    { echo; echo "## $title"; echo; echo "\`$*\`"; echo; } >>"$file"
    timeout --signal=INT --kill-after=10 "$limit" "$@" >"$runs/out" 2>"$runs/err"
    local status=$?
    cat "$runs/out" >>"$file"
    if [ $status -ne 0 ]; then
        { echo; echo "Ended with status $status (124: out of time). Its last lines:"; echo
          tr '\r' '\n' <"$runs/err" | tail -n 5 | sed 's/^/    /'; } >>"$file"
    fi
    { echo; echo "$((SECONDS - start)) s"; } >>"$file"
}

facts() {
    date -u +"%Y-%m-%d %H:%M UTC"; git rev-parse HEAD 2>/dev/null; nproc
    command -v nvidia-smi >/dev/null && nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader
    "$python" -c 'import torch, torchrl, mujoco, warp; print("torch", torch.__version__, "torchrl", torchrl.__version__, "mujoco", mujoco.__version__, "warp", warp.__version__)'
}

train() { echo "$python" train.py logger=none device="$device" hydra.run.dir="$runs/$1" "${@:2}"; }

if [ "$device" = cpu ]; then  # sizes for a try
    worlds=(4) steps=3 goal=(PointGoal1)
    on_policy=(num_envs=4 frames_per_batch=80 frames=160 env.num_steps=20 critic_update.minibatch_size=40 certificate.episodes=0)
    off_policy=(num_envs=4 frames_per_batch=160 frames=320 env.num_steps=40 exploration.random_steps=160 certificate.episodes=0)
else
    worlds=(4096 16384) steps=100 goal=(CarGoal1 PointGoal1)
    on_policy=()
    off_policy=(num_envs=1024 frames_per_batch=40960 frames=1_000_000)
fi

echo "# GPU session" >"$file"
facts >>"$file" 2>&1
part "Steps/s of environments and of training" 150 \
    "$python" benchmarks/gpu_throughput.py "${goal[@]}" --device "$device" --worlds "${worlds[@]}" --steps "$steps" --cpu-worlds "${worlds[0]}" --training
part "CarGoal1, PPO-Lagrangian, to the certificate" 210 \
    $(train car env=CarGoal1 algo=ppo_lagrangian preset=gpu "${on_policy[@]}")
part "PointGoal1, SAC-Lagrangian with held actions, to the certificate" 110 \
    $(train held env=PointGoal1 algo=sac_lagrangian preset=hard_tasks env.physics=warp "${off_policy[@]}")
echo "$file"
