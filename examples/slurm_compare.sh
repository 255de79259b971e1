#!/bin/bash
# A comparison as a SLURM array: sbatch examples/slurm_compare.sh --plan table1 --data pack --data.path packs/tag --out runs/table1
# Every task is the same command and takes the runs that no other task has: their locks are files beside the runs, so
# --out must be on a file system that locks across machines. The last one to end has made the whole table.
#SBATCH --job-name=mvitac-compare
#SBATCH --array=0-7
#SBATCH --gpus-per-node=1
#SBATCH --cpus-per-task=8
#SBATCH --time=10:00:00
set -e
mvitac compare "$@"
