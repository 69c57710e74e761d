#!/bin/bash
# Pseudo ex vivo: six recordings of 30 s that differ from the training data in every family, and every method.
# Needs a photograph of a cortex for the texture: docs/results/exvivo/run.sh PHOTO WORK
set -e
photo=$1 work=$2
synth render docs/results/gap/data.yaml -o "$work/data"
bench make-exvivo -o "$work/recordings" --count 6 --seconds 30 --fps 10 --photo "$photo" --seed 100

train() { learn train "$work/data" -o "$work/$1" --preset tiny --epochs 30 --hold-out calf --output magnitude "${@:2}"; }
train mixed --input mixed
train ideal --input ideal
train recovered --input recovered
train unet --input mixed arch.name=unet
train small --input mixed arch.stem=4 arch.levels=2

for recording in "$work"/recordings/*; do
  bench score "$recording" --model "$work/mixed" --train "$work/data" -o "$work/scores/$(basename "$recording")" \
    --also "D2FNet, ideal flow=$work/ideal" --also "D2FNet, recovered flow=$work/recovered" \
    --also "U-Net, MSE=$work/unet" --also "d2fnet-s=$work/small"
done
bench pool "$work"/scores/* -o docs/results/exvivo
