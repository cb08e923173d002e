#!/usr/bin/env bash
# Train models of intuition, from states, masks and pixels, on one machine, from nothing.
#
#     bash benchmarks/gpu.sh [OUT] [DATA]
#
# It makes own trials on all cores for MAKE seconds (default 240), keeps what was made, trains the
# three models at the same time for STEPS steps, and writes tables, predictions and weights as
# float16 to OUT/gpu.tar. DATA holds trials and trainings, in memory where there is room; the same
# command continues. It needs the package's dependencies and torch with CUDA; on a CPU it does the
# same, slowly.
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-${OUT:-runs/gpu}} data=${2:-runs/gpu-data} steps=${STEPS:-4000}
workers=$(nproc)  # before OMP_NUM_THREADS, which it heeds
export PYTHONPATH=$PWD/src${PYTHONPATH:+:$PYTHONPATH} OMP_NUM_THREADS=1 PYTHONUNBUFFERED=1
mkdir -p "$out" "$data/said" "$data/weights"
rm -f "$data/failed"
trials=(python benchmarks/models/intuition_trials.py "$data" --workers "$workers"
    --models intuition-states intuition-masks intuition-pixels)
"${trials[@]}" --official | tail -n 1
"${trials[@]}" --trials "${TRIALS:-20000}" --seconds "${MAKE:-240}" > "$data/said/made.txt" 2>&1
echo "$(ls "$data/own" | wc -l) files of own trials"
for model in intuition-states intuition-masks intuition-pixels; do
    python benchmarks/models/train_intuition.py "$data" --models "$model" --steps "$steps" \
        --weights "$data/weights" > "$data/said/$model.txt" 2>&1 || touch "$data/failed" &
done
wait
tail -n 5 "$data"/said/intuition-*.txt
tar -C "$data" -cf "$out/gpu.tar" said weights predictions
[[ ! -e "$data/failed" ]]
