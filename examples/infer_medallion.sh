#!/bin/sh
# Estimate the normals of the medallion with the shipped weights and print the mean angular error from the report.
#
#   examples/infer_medallion.sh [OUT]             # default: out, in the repository
#
# The variables SPLINECLI and PYTHON name the programs to run, by default `splinecli` and `python3`.
set -eu

out=${1:-}
case $out in
  '') out=out ;;
  /*) ;;
  *) out=$PWD/$out ;;
esac
cd "$(dirname "$0")/.."

# stdout is a list of reports and nothing else; the same report is in $out/medallion/report.json.
"${SPLINECLI:-splinecli}" infer examples/medallion -o "$out" --overwrite --json > /dev/null

"${PYTHON:-python3}" - "$out/medallion/report.json" <<'END'
import json, sys

report = json.load(open(sys.argv[1], encoding="utf-8"))
errors = report["angular_error_deg"]
print(f"{report['method']}, {report['n_lights']} lights: MAE {errors['mean']:.2f} deg, median {errors['median']:.2f} deg")
END
echo "see $out/medallion/normals.png and error_map.png"
