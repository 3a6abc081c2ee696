#!/bin/sh
# Compare a GPU with the processor, and train the refinement nets on it, within some minutes on a bare machine:
#
#     sh benchmarks/gpu_session.sh OUT [DATA] [MINUTES]
#
# OUT gets report.txt, report.json and the run of the nets, refine/. DATA may have meshes, shapes/*.ply, tileable normal
# maps, relief/*.jpg, and captures with ground truth, statues/*. Their shapes are left out of training. MINUTES, 12 by
# default, is the time of all steps. See gpu_session.py.
#
# A python3 whose PyTorch computes on the device is used with its packages. What is missing is installed into a
# temporary environment; without a package index, PIP_NO_INDEX=1 PIP_FIND_LINKS=FOLDER takes wheels from a folder.
# DEVICE=cpu SIZE=small MINUTES=5 tries the script on a processor.
set -eu
started=$(date +%s)
out=${1:?name a folder for the report and the weights}
data=${2:-}
minutes=${3:-${MINUTES:-12}}
device=${DEVICE:-cuda}
root=$(cd "$(dirname "$0")/.." && pwd)

mkdir -p "$out"
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
log=$work/install.log
python3 -m venv "$work/venv" >"$log" 2>&1 || python3 -m venv --without-pip "$work/venv"
python=$work/venv/bin/python
if python3 -c "import torch; torch.zeros(1, device='$device')" 2>>"$log"; then
  # --system-site-packages would leave out the packages of a python3 that is in an environment itself.
  site=$("$python" -c "import sysconfig; print(sysconfig.get_path('purelib'))")
  python3 -c "import sys; print(*(path for path in sys.path if path.endswith('-packages')), sep='\n')" >"$site/outer.pth"
fi

# The checkout itself is not built: that needs setuptools, which a bare machine may not have.
"$python" - "$root/pyproject.toml" >"$work/requirements.txt" <<'END'
import sys, tomllib
project = tomllib.load(open(sys.argv[1], "rb"))["project"]
extras = project["optional-dependencies"]
print(*project["dependencies"], *extras["render"], *extras["cluster"], sep="\n")
END
install() {
  "$python" -m pip install --quiet --disable-pip-version-check --retries 1 --timeout 10 "$@" >>"$log" 2>&1
}
# One by one if one of them cannot be had: most steps do without embreex and distributed.
install -r "$work/requirements.txt" || while read -r requirement; do
  install "$requirement" </dev/null || echo "not installed: $requirement" >>"$log"
done <"$work/requirements.txt"

export PYTHONPATH="$root/src${PYTHONPATH:+:$PYTHONPATH}" OMP_WAIT_POLICY="${OMP_WAIT_POLICY:-passive}"
"$python" "$root/benchmarks/gpu_session.py" "$out" --data "$data" --minutes "$minutes" --started "$started" \
  --device "$device" --size "${SIZE:-full}" --work "$work"
