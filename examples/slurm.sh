#!/bin/bash
# Pre-train on 2 nodes with 8 GPUs each: PACK=/data/pack sbatch examples/slurm.sh
# A killed or requeued job continues from its last checkpoint.
#SBATCH --job-name=mvitac
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=1
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=32
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --signal=TERM@120

set -euo pipefail
PACK=${PACK:?set PACK to the folder of a pack: PACK=/data/pack sbatch examples/slurm.sh}
OUT=${OUT:-runs/slurm}
HEAD=$(scontrol show hostnames "$SLURM_JOB_NODELIST" | head -n 1)

srun torchrun \
  --nnodes "$SLURM_NNODES" --nproc-per-node 8 --max-restarts 3 \
  --rdzv-id "$SLURM_JOB_ID" --rdzv-backend c10d --rdzv-endpoint "$HEAD:29500" \
  -m mvitac pretrain --recipe modern --data pack --data.path "$PACK" \
  --batch-size 2048 --checkpoint-every 200 --out "$OUT" --resume --quiet
