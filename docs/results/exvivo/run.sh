#!/bin/bash
# Pseudo ex vivo: six recordings of 30 s that differ from the training data in every family, by the network that comes along.
# Needs a photograph of a cortex for the texture: docs/results/exvivo/run.sh PHOTO WORK
set -e
photo=$1 work=$2
bench make-exvivo -o "$work/recordings" --count 6 --seconds 30 --fps 10 --photo "$photo" --seed 100
for recording in "$work"/recordings/*; do
  bench score "$recording" --model mono -o "$work/scores/$(basename "$recording")"
done
bench pool "$work"/scores/* -o docs/results/exvivo --by "docs/results/exvivo/run.sh PHOTO WORK"
