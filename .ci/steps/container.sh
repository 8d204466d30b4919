# The image, built on a real engine and driven there: compliance, attacks, and how things end.
# Proves that the image serves as this checkout does, and that its walls hold.
# Everything lies in the work folder, and an engine that is started here is stopped here.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"

missing=()
for package in docker.io gpg mmdebstrap; do
  dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q 'ok installed' ||
    missing+=("$package")
done
if [ ${#missing[@]} -gt 0 ]; then
  if [ "$(id -u)" != 0 ]; then
    echo "only root can install ${missing[*]}" >&2
    exit 1
  fi
  # a service that the package starts would keep its images outside of the work folder
  printf '#!/bin/sh\nexit 101\n' >"$CI_WORK/policy" && chmod 755 "$CI_WORK/policy"
  [ -e /usr/sbin/policy-rc.d ] || { cp "$CI_WORK/policy" /usr/sbin/policy-rc.d; policy=ours; }
  export DEBIAN_FRONTEND=noninteractive
  patiently apt-get update -qq
  patiently apt-get install -y -qq --no-install-recommends "${missing[@]}" >/dev/null
  [ "${policy:-}" != ours ] || rm /usr/sbin/policy-rc.d
fi

base=envhub-ci-base:$$ image=envhub-ci-worker:$$ engine=
finish() {
  docker image rm --force "$image" "$base" >/dev/null 2>&1 || true
  [ -n "$engine" ] || return 0
  kill "$engine"
  wait "$engine" || true
  # it leaves a network namespace mounted
  awk -v below="$CI_WORK/docker/" 'index($2, below) == 1 {print $2}' /proc/mounts |
    sort -r | xargs -r umount
}
trap finish EXIT
if ! docker info >/dev/null 2>&1; then
  mkdir "$CI_WORK/docker"
  dockerd --data-root "$CI_WORK/docker/data" --exec-root "$CI_WORK/docker/run" \
    --pidfile "$CI_WORK/docker/pid" >"$CI_WORK/docker/log" 2>&1 &
  engine=$!
  for _ in $(seq 60); do
    docker info >/dev/null 2>&1 && break
    kill -0 "$engine" || { tail -20 "$CI_WORK/docker/log" >&2; exit 1; }
    sleep 1
  done
fi
docker version --format 'docker {{.Server.Version}}'

# No registry needs to be reachable: the base image is a plain Debian of this machine's mirror, and
# trusts whom this machine trusts.
authorities=/etc/ssl/certs/ca-certificates.crt
base_image() {
  mmdebstrap --quiet --variant=minbase --include=python3,python3-venv,ca-certificates \
    --customize-hook="copy-in $authorities $(dirname $authorities)" bookworm - |
    docker import --change "ENV PIP_CERT=$authorities SSL_CERT_FILE=$authorities" - "$base" >/dev/null
}
patiently base_image
docker build --quiet --network host --build-arg "BASE_IMAGE=$base" --tag "$image" . >/dev/null
docker image inspect --format 'the image has {{.Size}} bytes' "$image"

# what runs and checks examples/deployment; Compose as a plugin of the engine's command
make_venv "$(find_python 3.11 || command -v python3)" "$CI_WORK/deployment" --group deployment
export PATH=$PATH:$CI_WORK/deployment/bin DOCKER_CONFIG=$CI_WORK/docker-config
mkdir -p "$DOCKER_CONFIG/cli-plugins"
ln -sf "$CI_WORK"/deployment/lib/python*/site-packages/compose/docker-compose \
  "$DOCKER_CONFIG/cli-plugins/docker-compose"
docker compose version

export ENVHUB_CI=1 ENVHUB_TEST_IMAGE=$image
if checkout_of_tests "$CI_WORK/container"; then
  cd "$CI_WORK/container"
  with_summary container bash "$CI_AGAIN" "$CI_WORK/tests/venv/bin/python" -m pytest -n 2 --dist loadfile \
    --durations=20 tests/containers
else
  export ENVHUB_TEST_DIR=$CI_WORK/container ENVHUB_TEST_UV=$CI_UV ENVHUB_TEST_RUNNER="bash $CI_AGAIN"
  with_summary container ./test -n 2 --dist loadfile --durations=20 tests/containers
fi
