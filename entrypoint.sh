#!/bin/sh
# Where a container begins: numba wants to write to its cache, so the kernels that came with the image go where it may.
set -e
mkdir -p "$NUMBA_CACHE_DIR"
cp -R /opt/kernels/. "$NUMBA_CACHE_DIR"
exec "$@"
