# syntax=docker/dockerfile:1
# The service: Python, ONNX Runtime, the models that ship, object storage and DICOM; no torch, no compiler, no root.
#   docker build --file docker/service.Dockerfile --tag morphoflow .
FROM python:3.11-slim-bookworm AS build

ENV PIP_NO_CACHE_DIR=1 PYTHONDONTWRITEBYTECODE=1
WORKDIR /src
COPY . .
RUN docker/install.sh /opt/morphoflow cluster pacs


FROM python:3.11-slim-bookworm AS service

LABEL org.opencontainers.image.title="MorphoFlow" \
      org.opencontainers.image.description="3-D shape from sparse segmentations, with its uncertainty" \
      org.opencontainers.image.licenses="Apache-2.0"

RUN groupadd --system --gid 10001 morphoflow \
 && useradd --system --uid 10001 --gid 10001 --no-create-home --home-dir /data --shell /usr/sbin/nologin morphoflow \
 && install --directory --owner 10001 --group 10001 --mode 0750 /data

COPY --from=build /opt/morphoflow /opt/morphoflow

# Listening beyond the container wants a key: set MORPHOFLOW_API_KEYS, or MORPHOFLOW_ALLOW_OPEN=true behind a gateway.
ENV PATH=/opt/morphoflow/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    MORPHOFLOW_HOST=0.0.0.0 \
    MORPHOFLOW_PORT=8080 \
    MORPHOFLOW_RESULTS_FOLDER=/data/results

# Writable are only the results and /tmp: the root file system may be mounted read-only.
USER 10001:10001
WORKDIR /data
VOLUME ["/data"]
EXPOSE 8080 11112
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=3s --start-period=30s --retries=3 \
    CMD ["python", "-c", "import os, urllib.request as r; r.urlopen(f'http://127.0.0.1:{os.environ[\"MORPHOFLOW_PORT\"]}/readyz', timeout=2)"]

CMD ["morphoflow", "serve"]
