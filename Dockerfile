# simrun in a container. On a CPU:        docker build -t simrun .
# With CUDA (an Ubuntu 24.04 base):       docker build -t simrun-cuda --build-arg BASE=nvidia/cuda:12.8.1-runtime-ubuntu24.04 .
# torch comes from pip's own index, which has its CUDA build; --build-arg TORCH_INDEX=URL names an index with CPU builds: gigabytes less.
# Then:                                   docker run --rm -v "$PWD:/work" simrun --renderer clean,3dgs smoke/curve
ARG BASE=python:3.11-slim-bookworm

FROM ${BASE} AS build
ARG TORCH_INDEX=
SHELL ["/bin/sh", "-euc"]
RUN if ! command -v python3 >/dev/null || ! python3 -c "import ensurepip"; then \
        apt-get update; \
        apt-get install -y --no-install-recommends python3 python3-venv; \
        rm -rf /var/lib/apt/lists/*; \
    fi
RUN python3 -m venv /opt/simrun
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
# torch first, in a layer of its own: it is large, and changes seldom
RUN /opt/simrun/bin/pip install ${TORCH_INDEX:+--index-url "${TORCH_INDEX}"} "torch>=2.8,<3"
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY alpasim_plugin alpasim_plugin
COPY configs configs
COPY evaluators evaluators
COPY policies policies
COPY scenarios scenarios
COPY simrun simrun
COPY docs docs
RUN /opt/simrun/bin/pip install .
# Kernels for the processor of the building machine; another kind compiles its own at the first run.
RUN NUMBA_CACHE_DIR=/opt/simrun/numba /opt/simrun/bin/simrun doctor

FROM ${BASE}
SHELL ["/bin/sh", "-euc"]
# Triton compiles the part that starts its kernels with gcc.
RUN if ! command -v python3 >/dev/null; then \
        apt-get update; \
        apt-get install -y --no-install-recommends python3 python3-dev gcc libc6-dev; \
        rm -rf /var/lib/apt/lists/*; \
    fi
RUN useradd --create-home --uid 10001 simrun && mkdir /work && chown simrun /work
COPY --from=build /opt/simrun /opt/simrun
RUN mkdir -p /home/simrun/.cache && mv /opt/simrun/numba /home/simrun/.cache/numba && chown -R simrun /home/simrun/.cache
# Compiled kernels and fitted scenes go to the user's home: what is installed is read-only. Mount it to keep them.
ENV PATH=/opt/simrun/bin:$PATH \
    NUMBA_CACHE_DIR=/home/simrun/.cache/numba \
    PYTHONUNBUFFERED=1
USER 10001
WORKDIR /work
ENTRYPOINT ["simrun"]
CMD ["--help"]
