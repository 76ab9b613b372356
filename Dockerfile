# The image that flies: all parts of a mission, nothing for training. The root file system may be read-only; the user is not root.
ARG BASE=python:3.11-slim-bookworm

FROM ${BASE} AS build
WORKDIR /src
COPY . .
RUN python3 -m venv /opt/plumeward \
    && /opt/plumeward/bin/pip install --no-cache-dir --no-compile --only-binary :all: --require-hashes -r requirements.txt \
    && /opt/plumeward/bin/pip install --no-cache-dir --no-compile --no-deps --no-build-isolation .

# Delete what no flight loads.
RUN /opt/plumeward/bin/pip uninstall --yes --quiet hatchling editables packaging pathspec pluggy tomlkit trove-classifiers pip setuptools \
    && find /opt/plumeward \( -path '*/numba/tests/*' -o -path '*/llvmlite/tests/*' \
        -o -path '*/pymavlink/dialects/*' ! -path '*/v20/common.py' ! -path '*/v20/all.py' ! -name __init__.py -type f \) -delete \
    && python3 -m compileall -q /opt/plumeward/lib

# Compile the kernels for the CPU of the build machine. On another CPU numba compiles them again, in about half a minute.
WORKDIR /opt/plumeward
ENV NUMBA_CACHE_DIR=/opt/kernels
RUN bin/python -m agent rollout \
    && bin/python -m agent rollout --policy infotaxis \
    && bin/python -m agent rollout --policy ppo

FROM ${BASE}
RUN useradd --uid 10001 --user-group --no-log-init --home-dir /data plumeward \
    && install --directory --owner=plumeward --group=plumeward /data /data/runs /data/certs
COPY --from=build /opt /opt
COPY entrypoint.sh /usr/local/bin/
USER 10001:10001
WORKDIR /data
ENV PATH=/opt/plumeward/bin:$PATH NUMBA_CACHE_DIR=/tmp/kernels
ENTRYPOINT ["entrypoint.sh"]
CMD ["plumeward"]
