# The README's first command, word for word, in a clean copy of the checkout.
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/../lib.sh"
command=$(awk '/^```sh$/ {inside = 1; next} /^```$/ {if (inside) exit} inside' README.md)
echo "\$ $command"
mkdir "$CI_WORK/readme" && cp -R . "$CI_WORK/readme/checkout" && cd "$CI_WORK/readme/checkout"
ENVHUB_CACHE=$CI_WORK/readme/cache bash -euo pipefail -c "$command"
test -s cartpole.mp4
