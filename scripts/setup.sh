#!/usr/bin/env bash
# Creates the virtual environment and installs the project with everything that demo, service and tests need.
# Settings: PYTHON (default python3), VENV (default .venv), TORCH_INDEX (see scripts/install_torch.py).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python="${PYTHON:-python3}"
venv="${VENV:-.venv}"
extras="train,service,ray,oracle,plans,ifc,ocr,docs,dev"
is_recent='import sys; sys.exit(sys.version_info < (3, 11))'

fail() {
    printf 'setup: %s\n' "$*" >&2
    exit 1
}

check_python() {
    command -v "$python" >/dev/null || fail "no '$python' here; install Python 3.11 or later, or say: make PYTHON=..."
    "$python" -c "$is_recent" ||
        fail "'$python' is $("$python" --version 2>/dev/null || echo unusable); Python 3.11 or later is needed; say for instance: make PYTHON=python3.12"
}

# An environment that works is kept, so that a change of pyproject.toml does not download torch again.
create_venv() {
    if [ -x "$venv/bin/python" ] && "$venv/bin/python" -c "$is_recent" 2>/dev/null &&
        "$venv/bin/python" -m pip --version >/dev/null 2>&1; then
        return
    fi
    check_python
    "$python" -m venv --clear "$venv" ||
        fail "'$python' cannot create virtual environments; on Debian and Ubuntu the package is python3-venv"
}

create_venv
# Without compiled files, which Python writes itself for the few modules that are imported.
export PIP_NO_COMPILE=1 PIP_DISABLE_PIP_VERSION_CHECK=1
# Torch comes while the others do.
"$venv/bin/python" scripts/install_torch.py &
torch=$!
# Every package by its digest, of the lock that `make lock` writes for these extras, so that there is nothing to resolve:
# by uv, which takes a tenth of pip's time, or by pip, where only pip is configured for a mirror.
pip_install=("$venv/bin/python" -m pip install --no-deps)
"${pip_install[@]}" --require-hashes -r <(sed -n '/^uv==/,/[^\\]$/p' requirements.lock)
"$venv/bin/uv" pip install --python "$venv/bin/python" --no-deps --require-hashes -r requirements.lock ||
    "${pip_install[@]}" --require-hashes -r requirements.lock
wait "$torch"
"${pip_install[@]}" --no-build-isolation -e ".[$extras]"
printf 'setup: done, the environment is in %s\n' "$venv"
