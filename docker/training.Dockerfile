# syntax=docker/dockerfile:1
# Training on an NVIDIA GPU. The base brings the driver's interface; torch's wheels bring the CUDA libraries.
#   docker build --file docker/training.Dockerfile --tag morphoflow-training .
#   docker run --gpus all --volume "$PWD/data:/data:ro" --volume "$PWD/runs:/runs" morphoflow-training morphoflow train --help
ARG CUDA_IMAGE=nvidia/cuda:13.0.2-base-ubuntu24.04
FROM ${CUDA_IMAGE} AS build

ENV DEBIAN_FRONTEND=noninteractive
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install --yes --no-install-recommends python3 python3-venv \
 && rm -rf /var/lib/apt/lists/*

ENV PIP_NO_CACHE_DIR=1 PYTHONDONTWRITEBYTECODE=1
WORKDIR /src
COPY . .
RUN docker/install.sh /opt/morphoflow training


FROM ${CUDA_IMAGE} AS training

ENV DEBIAN_FRONTEND=noninteractive
# hadolint ignore=DL3008
RUN apt-get update \
 && apt-get install --yes --no-install-recommends python3 \
 && rm -rf /var/lib/apt/lists/* \
 && groupadd --system --gid 10001 morphoflow \
 && useradd --system --uid 10001 --gid 10001 --create-home --shell /usr/sbin/nologin morphoflow \
 && install --directory --owner 10001 --group 10001 --mode 0750 /runs

COPY --from=build /opt/morphoflow /opt/morphoflow

ENV PATH=/opt/morphoflow/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility

USER 10001:10001
WORKDIR /runs
VOLUME ["/runs"]
CMD ["morphoflow", "--help"]
