#!/usr/bin/env bash
# Train what waits for a GPU: intuition from pixels, masks and states, on one machine, from nothing.
#
#     bash benchmarks/gpu.sh [OUT] [DATA]
#
# It makes own trials on all cores for MAKE seconds (default 240), keeps what was made, trains, and
# writes tables and weights as float16 (under 16 MB each) to OUT. DATA holds trials and trainings;
# the same command continues. PIXELS, STEPS and BATCH set picture size and length of the training.
# It needs the package's dependencies and torch with CUDA; on a CPU it does the same, slowly.
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-${OUT:-runs/gpu}} data=${2:-runs/gpu-data}
export PYTHONPATH=$PWD/src OMP_NUM_THREADS=1 PYTHONUNBUFFERED=1
mkdir -p "$out"
trials=(python benchmarks/models/intuition_trials.py "$data" --workers "$(nproc)" --pixels "${PIXELS:-96}")
"${trials[@]}" --official | tail -n 1
timeout --signal=INT "${MAKE:-240}" "${trials[@]}" --trials "${TRIALS:-20000}" > "$out/made.txt" || true
tail -n 1 "$out/made.txt"
unset OMP_NUM_THREADS
for model in intuition-states intuition-masks intuition-pixels; do
    python benchmarks/models/train_intuition.py "$data" --models "$model" --weights "$out" \
        --steps "${STEPS:-4000}" --batch "${BATCH:-128}" | tee "$out/$model.txt"
done
cp -r "$data/predictions" "$out/"
