#!/bin/bash
# Trains on two nodes with eight GPUs each, one process per GPU:  sbatch examples/slurm.sh
#
# Five minutes before the time is up SLURM signals the training; it saves, stops, and the job queues
# again and goes on where it was. Submit from a directory that all nodes share: the run is in it.
#SBATCH --job-name=carljax
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=8
#SBATCH --gpus-per-node=8
#SBATCH --cpus-per-task=8
#SBATCH --time=08:00:00
#SBATCH --signal=TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output=carljax-%j.log
# Every task must see all GPUs of its node (so no --gpus-per-task): JAX gives each task the one of its
# local number.
set -eu

RUN=runs/carl-carla
if [ -e "$RUN/config.json" ]; then
  what=(--resume "$RUN")
else
  what=(carl-carla --run.dir "$RUN")
fi

srun python -m carljax.train "${what[@]}" --distributed

# The evaluation is the last that a run does. Without it the run was stopped.
if [ ! -e "$RUN/evaluation.json" ]; then
  scontrol requeue "$SLURM_JOB_ID"
fi
