#!/bin/bash
# A sweep on a local Ray: six jobs, one that fails, one that is killed; and the sweep again. What it expects is checked.
#
#   pip install -e '.[ray]'
#   benchmarks/ray.sh [folder]
set -euo pipefail

work=$(realpath -m "${1:-/tmp/hno-ray}")
hno="${PYTHON:-python} -m hno"
rm -rf "$work" && mkdir -p "$work"
export HNO_CACHE="${HNO_CACHE:-$work/labels}" RAY_USAGE_STATS_ENABLED=0
sweep="$work/sweep"
words=(experiment=smoke "data.types=[[1,1]]" evaluation.dt=0.25 trainer.max_steps=${STEPS:-200} trainer.validate_every=20)
words+=("optimizer.lr=1e-3,2e-3,3e-3,4e-3,5e-3,1e30")
ray=(launcher=ray +launcher.ray.init.num_cpus=${CPUS:-$(nproc --all)} +launcher.ray.init.include_dashboard=false)

$hno train -m "${ray[@]}" "${words[@]}" --to "$sweep" & run=$!
until [ -f "$sweep/1_narrow_road_hno_auto_sin_lr-0.002/last.ckpt" ]; do sleep 0.2; done
pid=$(grep -o '"process": \["[^"]*", [0-9]*' "$sweep"/.jobs-*/1.json | grep -o '[0-9]*$')
echo "killing process $pid of job 1"
kill -KILL "$pid"
wait $run && exit 1 || echo "The sweep ended with exit code $?."
cut -c 1-100 "$sweep/sweep.log"
grep -q "Job 1 finished, resumed" "$sweep/sweep.log"   # Ray began it again
first=$(wc -l < "$sweep/sweep.log")

$hno train sweep="$sweep" "${ray[@]}" && exit 1 || echo "Again, it ended with exit code $?."
tail -n +$((first + 1)) "$sweep/sweep.log" | cut -c 1-100
for expected in "skipped 5" "repeated 1" "failed 1"; do
    set -- $expected
    [ "$(tail -n +$((first + 1)) "$sweep/sweep.log" | grep -c "$1")" = "$2" ] || { echo "expected $2 $1"; exit 1; }
done
${PYTHON:-python} -c "import ray; print('ray', ray.__version__)"
$hno --version
