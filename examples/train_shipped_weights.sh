#!/bin/sh
# Train the weights that come with splinecli from scratch, in about eighteen hours on two cores:
#
#     sh examples/train_shipped_weights.sh FOLDER
#
# Needs the extra 'render' (pip install -c constraints.txt '.[render]'). If it is
# interrupted, the same command continues. Seeds and numbers of steps are fixed. See MODEL_CARD.md.
set -eu
folder=${1:?name a folder for the scenes and the runs}

splinecli=${SPLINECLI:-splinecli}
"$splinecli" prepare --scenes 15 --size 96 --n-lights 200 --seed 21 -o "$folder/scenes"
"$splinecli" prepare --scenes 120 --size 128 --n-lights 100 --seed 101 -o "$folder/whole-scenes"

# Resume a run that was interrupted; skip a run that is finished.
run() {
  name=$1
  set=$2
  shift 2
  if [ -e "$folder/$name/finished" ]; then return; fi
  if [ -e "$folder/$name/checkpoint.safetensors" ]; then set -- "$@" --resume; fi
  "$splinecli" train "$folder/$set" "$@" -o "$folder/$name"
  touch "$folder/$name/finished"
}
run spline-net-1 whole-scenes --preset compact --generator-weight 0.7 --steps 67000
run spline-net-2 whole-scenes --preset compact --generator-weight 0.7 --steps 4000 --param learning_rate=1e-3 \
  --param network.error_head=true --param updates=error_head --start-from "$folder/spline-net-1/weights.safetensors"
run spline-net-3 whole-scenes --preset refine --steps 47000 \
  --param network.refines_twice=false --start-from "$folder/spline-net-2/weights.safetensors"
run spline-net-4 whole-scenes --preset refine --steps 10000 --param learning_rate=4e-4 \
  --start-from "$folder/spline-net-3/weights.safetensors"
run cnn-ps-1 scenes --preset cnn-ps --generator-weight 3 --steps 8136
run cnn-ps-2 scenes --preset cnn-ps --generator-weight 2 --steps 4318 --param learning_rate=6e-4 \
  --start-from "$folder/cnn-ps-1/weights.safetensors"

# The material net reads the tokens of the spline-net in the package, so put the new weights there first.
#   python benchmarks/train_material_net.py draw "$folder/material"
#   python benchmarks/train_material_net.py train "$folder/material" --ship
echo "$folder/spline-net-4/weights.safetensors"
echo "$folder/cnn-ps-2/weights.safetensors"
