#!/usr/bin/env bash
# Everything behind docs/results/real.md: manifests, pre-training, probes, tables. CPU only.
#   examples/real.sh ../shared/data runs/real 0 1 2          (data, output, seeds; stops and resumes at any point)
#   SETS="vt60 physiclear" examples/real.sh ...              (only these sets: several calls may run side by side)
set -euo pipefail
data=$1 out=$2
shift 2
seeds=("$@")
here=$(dirname "$0")
mvitac=(python -m mvitac)
[ -d "$out/manifests" ] || python "$here/real_manifests.py" "$data" "$out/manifests"

# pretrain NAME SPLIT SEED OPTIONS...: one run of the recipe demo cut to 300 steps (the sets are small); a finished one
# is left alone
pretrain() {
  local name=$1 split=$2 seed=$3 run="$out/$1/$2-seed$3"
  shift 3
  [ -f "$run/model.safetensors" ] || "${mvitac[@]}" pretrain --data folder --recipe demo --steps 300 "$@" --data.title "$name" \
    --data.path "$out/manifests/$name.csv" --data.group object --data.split "$split" --data.size 72 \
    --eval-every 0 --seed "$seed" --quiet --resume --out "$run"
}

# probe NAME SPLIT: all seeds of one split beside the controls; repeated when a run is newer
probe() {
  local json="$out/$1/$2.json" run stale=
  for run in "$out/$1/$2"-seed*; do [ "$json" -nt "$run/model.safetensors" ] || stale=yes; done
  [ -z "$stale" ] || "${mvitac[@]}" probe "$out/$1/$2"-seed* --json "$json"
}

# road NAME "SPLITS" OPTIONS...: all runs of a set, their probes, and one table
road() {
  local name=$1 splits=$2 split seed
  [[ " ${SETS:-$name} " == *" $name "* ]] || return 0
  shift 2
  for seed in "${seeds[@]}"; do
    for split in $splits; do pretrain "$name" "$split" "$seed" "$@"; done
  done
  for split in $splits; do probe "$name" "$split"; done
  if [ -f "$out/$name/fold1.json" ]; then
    python "$here/pool_folds.py" "$out/$name"/fold*.json > "$out/$name.md"
  else
    for split in $splits; do python "$here/pool_folds.py" "$out/$name/$split.json" > "$out/$name-$split.md"; done
  fi
}

road slip_grasp "fold1 fold2 fold3 fold4 fold5 fold6" --batch-size 32 --data.labels success --data.touch-group grasp \
  --data.label-only "seq<=4" --data.controls "width=width_mm" "width in sweep=width_in_sweep" \
  --data.licence MIT --data.source-url github.com/wkoa/slip_detection
road slip_gsmini "fold1 fold2 fold3" --batch-size 64 --data.labels slip --data.touch-group experiment \
  --data.controls "motion=motion_left,motion_right" "recording length=n_frames" \
  --data.licence BSD-2-Clause --data.source-url github.com/amitparag/Incipient-Slip-Detection
road physiclear "by-group owners_split" --batch-size 64 --data.labels material hardness roughness bumpiness \
  --data.touch-group video --data.controls "contact energy=contact_energy" --data.source-url github.com/clear-nus/octopi
road vt60 "fold1 fold2 fold3" --batch-size 32 --data.labels category --data.controls "pose=x,y,z" \
  --data.source-url github.com/Exhor/deep_visuotactile_classification
