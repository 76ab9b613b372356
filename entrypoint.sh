#!/bin/sh
# Entry point of the containers: numba needs a writable cache, so the image's kernels are copied to one.
set -e
mkdir -p "$NUMBA_CACHE_DIR"
cp -R /opt/kernels/. "$NUMBA_CACHE_DIR"
exec "$@"
