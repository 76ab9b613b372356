#!/bin/sh
# Installs Chromium, which the tests of the page drive. Does nothing where a browser is there already.
for name in chromium chromium-browser google-chrome google-chrome-stable; do
    if command -v "$name" > /dev/null; then exit 0; fi
done
root=
if [ "$(id -u)" != 0 ]; then root='sudo -n'; fi
if command -v apt-get > /dev/null && $root true 2> /dev/null; then
    echo 'installing Chromium, which the tests of the page drive, about 400 MB'
    if $root apt-get update -qq && $root env DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends \
        chromium fonts-dejavu-core > /dev/null; then exit 0; fi
fi
echo 'no Chromium: the tests of the page will be skipped (in CI they fail); install it: apt-get install chromium' >&2
