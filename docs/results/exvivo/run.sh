#!/bin/bash
# Pseudo ex vivo: six recordings of 30 s that differ from the training data in every family, by the networks that come along.
# Needs a photograph of a cortex for the texture: docs/results/exvivo/run.sh PHOTO WORK
set -e
photo=$1 work=$2
for eyes in one-eye:1:mono two-eyes:2:stereo; do
  IFS=: read -r name number model <<< "$eyes"
  python -m evidence.scoring.exvivo --out "$work/$name" --count 6 --seconds 30 --fps 10 --eyes "$number" --photo "$photo" --seed 100
  for recording in "$work/$name"/*; do
    bench score "$recording" --model "$model" -o "$work/scores-$name/$(basename "$recording")"
  done
  bench pool "$work/scores-$name"/* -o "docs/results/exvivo/$name" --by "docs/results/exvivo/run.sh PHOTO WORK"
done
