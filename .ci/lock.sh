#!/usr/bin/env bash
# Writes what action.yml and the Dockerfile install: .ci/locks, versions with hashes for pyproject.toml.
#
#   .ci/lock.sh            keeps the versions of the present locks that pyproject.toml permits
#   .ci/lock.sh --upgrade  takes the newest versions, and the base image of the day where Docker runs
#
# UV is the uv to use, if it is not on PATH.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
compile=("${UV:-uv}" pip compile --quiet --universal --python-version 3.10 --generate-hashes
  --only-binary :all: --no-annotate --custom-compile-command .ci/lock.sh "$@")
mkdir -p .ci/locks
# the action builds this package, with what its build needs
sed -n 's/^requires = \["\(.*\)"\]$/\1/p' pyproject.toml |
  "${compile[@]}" pyproject.toml - --output-file .ci/locks/action.txt
"${compile[@]}" --group image --output-file .ci/locks/image.txt

if [ "${1:-}" = --upgrade ] && docker info >/dev/null 2>&1; then
  tag=$(sed -n 's/^ARG BASE_IMAGE=\([^@]*\).*/\1/p' Dockerfile)
  docker pull --quiet "$tag" >/dev/null
  digest=$(docker image inspect --format '{{index .RepoDigests 0}}' "$tag")
  sed -i "s|^ARG BASE_IMAGE=.*|ARG BASE_IMAGE=$tag@${digest#*@}|" Dockerfile
fi
