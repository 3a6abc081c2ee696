#!/bin/sh
# Repeat the runs that made the weights of spline-net and of the light network that come with splinecli:
#
#     sh examples/train_shipped_weights.sh FOLDER SHAPES RELIEF [scratch]
#
# SHAPES is a folder with the meshes of CREDITS.md (.ply), RELIEF one with its tileable normal maps (.jpg). Needs the
# extra 'render' (pip install -c constraints.txt '.[render]') and a clone with its history, because the runs start from
# earlier weights. They take an estimated thirteen hours on two cores. With 'scratch', it first trains replacements of
# the earlier weights, and cnn-ps, in an estimated twenty hours more. If it is interrupted, the same command continues.
# See MODEL_CARD.md.
set -eu
folder=${1:?name a folder for the scenes and the runs}
shapes=${2:?name the folder of the meshes}
relief=${3:?name the folder of the normal maps}
splinecli=${SPLINECLI:-splinecli}
python=${PYTHON:-python}
here=$(dirname "$0")
fail() {
  echo "$0: $1" >&2
  exit 1
}
case ${4:-} in '' | scratch) ;; *) fail "found $4, expected 'scratch' or nothing" ;; esac
case $folder in *[[:space:]]*) fail "found a space in $folder, expected a path without spaces" ;; esac
"$python" -c 'import splinecli' || fail "activate the environment of splinecli, or set PYTHON"
[ -e "$shapes/boat.ply" ] || fail "found no boat.ply in $shapes, expected the meshes of CREDITS.md"
ls "$relief"/*.jpg > /dev/null 2>&1 || fail "found no .jpg in $relief, expected the normal maps of CREDITS.md"
mkdir -p "$folder"

processes=1
# Resume a run that was interrupted; skip a run that is finished.
run() {
  name=$1
  shift
  if [ -e "$folder/$name/finished" ]; then return; fi
  if [ -e "$folder/$name/checkpoint.safetensors" ]; then set -- "$@" --resume; fi
  "$python" -m torch.distributed.run --nproc-per-node "$processes" -m splinecli train "$@" -o "$folder/$name"
  touch "$folder/$name/finished"
}
# Write the weights of a network in an earlier commit: earlier COMMIT NETWORK FILE
earlier() {
  if [ -e "$3" ]; then return; fi
  git -C "$here" show "$1:src/splinecli/assets/$2.safetensors" > "$3.part" ||
    fail "needs a clone with its history: git fetch --unshallow"
  mv "$3.part" "$3"
}
combine() { "$python" "$here/../benchmarks/combine_weights.py" "$@"; }
light_net() { "$python" "$here/../benchmarks/train_light_net.py" "$@"; }
# Render sets of scenes, and list their folders in `sets`.
render() {
  sh "$here/render_training_scenes.sh" "$folder" "$shapes" "$relief" "$@"
  sets=
  for name in "$@"; do sets="$sets $folder/$name"; done
}

# keeps the runs of the two ways apart
of=${4:+-$4}
start=$folder/start$of.safetensors
if [ "${4:-}" = scratch ]; then
  scenes=$folder/scenes
  whole=$folder/whole-scenes
  "$splinecli" prepare --scenes 15 --size 96 --n-lights 200 --seed 21 -o "$scenes"
  "$splinecli" prepare --scenes 120 --size 128 --n-lights 100 --seed 101 -o "$whole"
  run spline-net-1 "$whole" --preset compact --generator-weight 0.7 --steps 67000
  run spline-net-2 "$whole" --preset compact --generator-weight 0.7 --steps 4000 --param learning_rate=1e-3 \
    --param network.error_head=true --param updates=error_head --start-from "$folder/spline-net-1/weights.safetensors"
  run spline-net-3 "$whole" --preset refine --steps 47000 \
    --param network.refines_twice=false --start-from "$folder/spline-net-2/weights.safetensors"
  run spline-net-4 "$whole" --preset refine --steps 10000 --param learning_rate=4e-4 \
    --start-from "$folder/spline-net-3/weights.safetensors"
  run cnn-ps-1 "$scenes" --preset cnn-ps --generator-weight 3 --steps 8136
  run cnn-ps-2 "$scenes" --preset cnn-ps --generator-weight 2 --steps 4318 --param learning_rate=6e-4 \
    --start-from "$folder/cnn-ps-1/weights.safetensors"
  cp "$folder/spline-net-4/weights.safetensors" "$start"
else
  earlier e1a8d46809746c318b7a58fe676dc158ade36d09 spline-net "$start" # after run 27 of docs/training-history.md
fi

# The pixelwise networks, then their error head. `sets` is split at spaces.
render fine-00 groups-00 groups-01 groups-02 groups-03 groups-04 groups-05 groups-06 groups-07 groups-08 large-00 \
  large-01 random-00 random-01 views-00
run "pixelwise$of" $sets --preset compact --generator-weight 10 --steps 48000 --seed 11 \
  --param learning_rate=8e-4 --start-from "$start"
run "errors$of" $sets --preset compact --generator-weight 10 --steps 4000 --param learning_rate=1e-3 \
  --param network.error_head=true --param updates=error_head --start-from "$folder/pixelwise$of/weights.safetensors"

# The refinement nets on scenes that these networks were not trained on, in two processes, which have captures of their
# own.
render groups-09 groups-10 random-02 random-03 views-01
joined=$folder/joined$of.safetensors
combine join "$folder/errors$of/weights.safetensors" "$start" "$joined"
processes=2
run "refined$of" $sets --preset refine --steps 3200 --seed 31 --param learning_rate=2e-4 \
  --param first_captures=200 --param shards=2 --start-from "$joined"

# The mean of start and end is better on unseen scenes than either of them.
combine mean "$joined" "$folder/refined$of/weights.safetensors" "$folder/weights$of.safetensors"
echo "$folder/weights$of.safetensors"

# The light network, which learns from small scenes.
if [ -n "$of" ]; then
  numbers='0 1 2 3 4 5 6 7 8 9'
  set -- --steps 60000
else
  numbers='3 4 5 6 7 8 9'
  earlier 9eb59c15b7b826fc110e9e1f5d8fa147d98450f7 light-net "$folder/light-start-4.safetensors" # after its run 3
  set -- --steps 32000 --start-from "$folder/light-start-4.safetensors"
fi
small=
for n in $numbers; do
  light_net draw "$folder/light-$n" "$shapes" "$relief" --seed $((7500 + n))
  small="$small $folder/light-$n"
done
light_net train $small "$@" -o "$folder/light-net-4$of.safetensors"
echo "$folder/light-net-4$of.safetensors"

# The material net reads the tokens of the spline-net in the package, so put the new weights there first.
# Its pixels are from the scenes of the sets of the light network.
#   python benchmarks/train_material_net.py draw "$folder/material" "$shapes" "$relief" "$folder"/light-[3-9]
#   python benchmarks/train_material_net.py train "$folder/material" --ship
