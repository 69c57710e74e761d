#!/bin/bash
# Pseudo ex vivo: six recordings of 30 s that differ from the training data in every family, and every method.
# Needs a photograph of a cortex for the texture: docs/results/exvivo/run.sh PHOTO WORK
# The three D2FNets are those of the gap experiment, seed 0.
set -e
photo=$1 work=$2
synth render docs/results/gap/data.yaml -o "$work/data"
bench gap "$work/data" --cache "$work/gap" --epochs 30 --seeds 2
bench make-exvivo -o "$work/recordings" --count 6 --seconds 30 --fps 10 --photo "$photo" --seed 100

train() { learn train "$work/data" -o "$work/$1" --preset tiny --epochs 30 --hold-out calf --input mixed arch.output=magnitude "${@:2}"; }
train unet arch.name=unet
train small arch.stem=4 arch.levels=2

net() { ls -d "$work"/gap/models/"$1"-seed0-*; }
for recording in "$work"/recordings/*; do
  bench score "$recording" --model "$(net mixed-tvl1)" --train "$work/data" \
    --also "D2FNet, ideal flow=$(net I)" --also "D2FNet, recovered flow=$(net R-tvl1)" \
    --also "U-Net, MSE=$work/unet" --also "d2fnet-s=$work/small" -o "$work/scores/$(basename "$recording")"
done
bench pool "$work"/scores/* -o docs/results/exvivo --by "docs/results/exvivo/run.sh PHOTO WORK"
