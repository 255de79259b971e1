#!/usr/bin/env bash
# Run all methods of Tables I and II on every dataset (CPU), after writing the manifests. docs/results/real.md has the
# options of its tables.
# Arguments: data folder, output folder, options of mvitac compare. A stopped script continues where it was stopped.
#   examples/real.sh ../shared/data runs/real
#   STEPS=150 SETS="vt60 physiclear-by-group" examples/real.sh ...    # shorter runs, only these datasets
set -euo pipefail
[ -d "${1:-}" ] && [ $# -gt 1 ] || { echo "data folder ${1:-} is not there, or no output folder was named" >&2; exit 2; }
data=$1 out=$2
shift 2
options=("$@")
[ -d "$out/manifests" ] || python "$(dirname "$0")/real_manifests.py" "$data" "$out/manifests"

sets="slip_grasp vt60 slip_gsmini physiclear-by-group physiclear-owners_split"
for name in ${SETS:-}; do
  [[ " $sets " == *" $name "* ]] || { echo "SETS has no $name, only $sets" >&2; exit 2; }
done

# methods NAME PLAN BATCH OPTIONS...: make one table. BATCH is the power of two nearest to the number of grasps or
# recordings in train, at most 64.
methods() {
  local name=$1 plan=$2 batch=$3
  shift 3
  [[ " ${SETS:-$name} " == *" $name "* ]] || return 0
  python -m mvitac compare --plan "$plan" --data folder --recipe quick --out "$out/$name" \
    --set steps="${STEPS:-300}" batch_size="$batch" eval_every=0 optim.lr=2e-3 augment.touch.flip=0.5 \
    --data.title "$name" --data.group object --data.size 72 "$@" "${options[@]}"
}

methods slip_grasp table2 32 --data.path "$out/manifests/slip_grasp.csv" --data.labels success --data.touch-group grasp \
  --data.label-only "seq<=4" --data.controls "width=width_mm" "width in sweep=width_in_sweep" \
  --folds split=fold1 split=fold2 split=fold3 split=fold4 split=fold5 split=fold6 \
  --data.licence MIT --data.source-url github.com/wkoa/slip_detection
methods vt60 table1 32 --data.path "$out/manifests/vt60.csv" --data.labels category --data.controls "pose=x,y,z" \
  --folds split=fold1 split=fold2 split=fold3 --data.source-url github.com/Exhor/deep_visuotactile_classification
methods slip_gsmini table2 64 --data.path "$out/manifests/slip_gsmini.csv" --data.labels slip --data.touch-group experiment \
  --data.controls "motion=motion_left,motion_right" "recording length=n_frames" \
  --folds split=fold1 split=fold2 split=fold3 \
  --data.licence BSD-2-Clause --data.source-url github.com/amitparag/Incipient-Slip-Detection
for split in by-group owners_split; do
  methods "physiclear-$split" table1 64 --data.path "$out/manifests/physiclear.csv" --data.split "$split" \
    --data.labels material hardness roughness bumpiness --data.touch-group video \
    --data.controls "contact energy=contact_energy" --data.source-url github.com/clear-nus/octopi
done
