#!/bin/sh
# Render the scenes that the weights of spline-net are trained on, about 1,500, in sets of up to an hour on one core:
#
#     sh examples/render_training_scenes.sh FOLDER SHAPES RELIEF [SET...]
#
# SHAPES is a folder with the meshes of CREDITS.md (.ply), RELIEF one with its tileable normal maps (.jpg). With names
# of sets, such as groups-07, only these are made. `unseen-*` is never trained on. If it is interrupted, the same
# command continues.
set -eu
folder=${1:?name a folder for the sets}
shapes=${2:?name the folder of the meshes}
relief=${3:?name the folder of the normal maps}
shift 3
splinecli=${SPLINECLI:-splinecli}

numbers() { seq -f '%02g' 0 "$1"; }
if [ $# = 0 ]; then
  set -- unseen-groups unseen-random unseen-views
  for n in $(numbers 9); do set -- "$@" "groups-$n" "groups-1$n" "groups-2$n" "random-$n" "large-$n"; done
  for n in $(numbers 4); do set -- "$@" "fine-$n" "views-$n"; done
fi
for name in "$@"; do
  number=${name##*-}
  # A number such as 08 is octal to the shell.
  number=${number#0}
  case $name in
    unseen-groups) scenes="--groups 24 --seed 9001" ;;
    unseen-random) scenes="--scenes 12 --seed 9002" ;;
    unseen-views) scenes="--views 1 --seed 9003" ;;
    groups-*) scenes="--groups 30 --seed $((6900 + number))" ;;
    large-*) scenes="--groups 15 --size 192 --seed $((7100 + number))" ;;
    fine-*) scenes="--groups 8 --size 256 --seed $((7200 + number))" ;;
    random-*) scenes="--scenes 30 --seed $((7300 + number))" ;;
    views-*) scenes="--views 1 --seed $((7400 + number))" ;;
    *)
      echo "$0: no set named $name" >&2
      exit 2
      ;;
  esac
  set -- $scenes
  for map in "$relief"/*.jpg; do set -- "$@" --relief "$map"; done
  # The other two meshes are those of the statues in docs/robustness.md.
  for mesh in "$shapes"/*.ply; do
    case $mesh:$name in
      *bust-wreath.ply:* | *maria.ply:* | *:*random*) ;;
      *) set -- "$@" --mesh "$mesh" ;;
    esac
  done
  "$splinecli" prepare "$@" -o "$folder/$name"
done
