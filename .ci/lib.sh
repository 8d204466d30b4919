# Functions of the steps; sourced.
: "${CI_WORK:?is the folder that a step works in}"  # without it, a step would write into /

heading() {
  printf '\n======== %s ========\n' "$*"
}

# patiently COMMAND...: once more, and a last time, if it fails: apt gives up where a mirror answers 503
# once, and so does what calls it. pip and uv ask again by themselves.
patiently() {
  local pause
  for pause in 5 30; do
    "$@" && return
    echo "failed, and is tried again in $pause s: $*" >&2
    sleep "$pause"
  done
  "$@"
}

# The files that git knows, as they are in the working tree.
copy_checkout() {
  mkdir -p "$1"
  git -c safe.directory='*' ls-files -z | xargs -0 cp --parents -t "$1"
}

# find_python 3.12: its path. A pyenv shim refuses to run a version that is not selected.
find_python() {
  local candidate
  for candidate in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}"/versions/"$1".*/bin/python \
    "/opt/pyenv/versions/$1".*/bin/python; do
    if "$candidate" -c 'import venv' 2>/dev/null; then
      command -v "$candidate"
      return
    fi
  done
  echo "no Python $1 on PATH or in pyenv" >&2
  return 1
}

# with_summary NAME COMMAND...: runs it, and keeps pytest's closing line for the end of the run, and
# what failed at first.
with_summary() {
  local name=$1 log=$CI_WORK/$1.log
  shift
  "$@" 2>&1 | tee "$log"
  {
    grep -E '^=*.*[0-9]+ passed' "$log" | head -1 | tr -d '='
    grep '^FAILED ONCE' "$log" || true
  } >"$CI_WORK/$name.summary"
}

# processes: for tests that start much and wait for it: three times as many as there are cores, as two
# for each still leave a quarter of their time idle, and the steps beside have a share of it. Not beyond
# eight, as in ./test.
processes() {
  local wanted=$(($(nproc) * 3))
  echo $((wanted < 8 ? wanted : 8))
}

# A skipped test fails, but for these, each with a reason that is said here.
permit_what_this_machine_lacks() {
  if ! ls ${PIP_FIND_LINKS:-/nowhere}/torch-*.whl >/dev/null 2>&1; then
    echo "no torch build without CUDA in PIP_FIND_LINKS: the tests that need torch are skipped"
    export ENVHUB_CI_WITHOUT_TORCH=1
  fi
  if ! [ -w /sys/fs/cgroup ] && ! [ -w /sys/fs/cgroup/memory ]; then
    echo "no control groups for this user: the tests that need them are skipped"
    export ENVHUB_CI_WITHOUT_CGROUPS=1
  fi
  if ! ls /dev/nvidia0 /dev/dri/renderD* >/dev/null 2>&1; then
    echo "no GPU: the tests of a real one are skipped"
    export ENVHUB_CI_WITHOUT_GPU=1
  fi
}

# install_into FOLDER ARGUMENT...: into the virtual environment there, by the uv of all steps.
install_into() {
  local folder=$1
  shift
  "$CI_UV" pip install --quiet --python "$folder/bin/python" "$@"
}

# make_venv PYTHON FOLDER [ARGUMENT...]: a virtual environment, and what is installed there.
make_venv() {
  "$CI_UV" venv --quiet --python "$1" "$2"
  [ $# = 2 ] || install_into "${@:2}"
}

# checkout_of_tests FOLDER: a copy of what the step "tests" tests, if its installation is complete. With
# times, by which its bytecode is known; again if a test that runs meanwhile has removed a file.
checkout_of_tests() {
  grep -q '^== [0-9]* s: testing ' "$CI_WORK/tests.log" 2>/dev/null || return
  cp -Rp "$CI_WORK/tests/checkout" "$1" || { rm -rf "$1" && cp -Rp "$CI_WORK/tests/checkout" "$1"; } || exit
  rm -rf "$1/.pytest_cache"
}

# wheel: the wheel that was built for all steps, or one built now.
wheel() {
  local found
  found=$(ls "$CI_WORK"/dist/*.whl 2>/dev/null) || true
  if [ -z "$found" ]; then
    "$CI_UV" build --quiet --wheel --out-dir "$CI_WORK/dist" . >&2
    found=$(ls "$CI_WORK"/dist/*.whl)
  fi
  echo "$found"
}

# smoke NAME PYTHON [OPTION...]: the wheel in an environment of its own, with a case of each test of
# what Python, Gymnasium, numpy, the Hub's client and the others are asked for: messages and spaces,
# the commands, references, a repository's own words, and real environments over both lanes.
smoke() {
  local name=$1 python=$2 built
  shift 2
  built=$(wheel)
  # compiled when first imported: a small part is
  make_venv "$python" "$CI_WORK/$name" "$@" "$built"
  install_into "$CI_WORK/$name" --group short
  "$CI_UV" pip list --python "$CI_WORK/$name/bin/python" --format freeze |
    grep -E '^(gymnasium|numpy|huggingface-hub|msgpack|pyzmq|cloudpickle|typer|click)=='
  copy_tests "$CI_WORK/$name/checkout"
  (
    cd "$CI_WORK/$name/checkout"
    with_summary "$name" bash "$CI_AGAIN" "$CI_WORK/$name/bin/python" -m pytest \
      -n logical --maxprocesses 8 --dist worksteal --one-case \
      tests/unit/{cli,protocol,client/{hub,transport,vector},worker/runner} tests/integration/hub \
      tests/integration/test_examples.py tests/compliance/test_parity.py::TestCounter
  )
}

# copy_tests FOLDER: what the tests need of the checkout, without the packages.
copy_tests() {
  mkdir -p "$1"
  cp -R .ci benchmarks docs examples plugins tests ./*.md Dockerfile .dockerignore action.yml mkdocs.yml \
    .pre-commit-hooks.yaml CITATION.cff LICENSE pyproject.toml \
    test "$1/"
}
