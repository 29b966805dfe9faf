#!/bin/sh
# install.sh TARGET [EXTRA...]: a virtual environment at TARGET with the tested versions and the project's wheel.
# Both images and the packaging test install in this way. Run from the root of the sources.
set -eu
target=$1
shift
extras=$(echo "$*" | tr ' ' ',')

"${PYTHON:-python3}" -m venv "$target"
"$target/bin/pip" install --disable-pip-version-check --quiet --constraint constraints.txt ".${extras:+[$extras]}"
