#!/bin/sh
# Makes the weights that come with splinecli from nothing, in about two and a half hours on two cores:
#
#     sh examples/train_shipped_weights.sh FOLDER
#
# Needs the extra 'render' (pip install -c constraints.txt '.[render]'). Cut off, the same command goes on. Seeds are fixed;
# how many steps fit into the minutes depends on the machine. See MODEL_CARD.md.
set -eu
folder=${1:?name a folder for the scenes and the runs}

splinecli=${SPLINECLI:-splinecli}
"$splinecli" prepare --scenes 18 --seed 11 -o "$folder/scenes"

# A run that was begun is resumed; one that is at its end is left alone.
run() {
  name=$1
  shift
  if [ -e "$folder/$name/finished" ]; then return; fi
  if [ -e "$folder/$name/checkpoint.safetensors" ]; then set -- "$@" --resume; fi
  "$splinecli" train "$@" -o "$folder/$name"
  touch "$folder/$name/finished"
}
run spline-net "$folder/scenes" --preset compact --generator-weight 3 --minutes 62
run cnn-ps --preset cnn-ps --minutes 60

echo "$folder/spline-net/weights.safetensors"
echo "$folder/cnn-ps/weights.safetensors"
