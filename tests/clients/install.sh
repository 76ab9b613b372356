#!/bin/sh
# Installs the clients that tests/clients/ drives, each into an environment of its own: .venv/clients/NAME, from NAME.txt here.
# The requirements that an environment was made from are copied into it last: an interrupted install lacks them and starts again.
failed=
for wanted in tests/clients/*.txt; do
    name=$(basename "$wanted" .txt)
    there=.venv/clients/$name
    if cmp -s "$wanted" "$there/requirements.txt" && "$there/bin/python" -c ''; then continue; fi
    echo "installing $name, which its tests drive, into $there"
    rm -rf "$there"
    if .venv/bin/python -m venv --without-pip "$there" &&
        .venv/bin/pip --python "$there" install --quiet --disable-pip-version-check --no-compile --no-deps -r "$wanted"; then
        cp "$wanted" "$there/requirements.txt"
    else
        failed="$failed $name"
    fi
done
if [ -n "$failed" ]; then echo "not installed:$failed; their tests will be skipped (in CI they fail)" >&2; fi
