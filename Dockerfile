# The worker alone: `envhub-worker` in an image that holds worker/ and what it imports, and nothing
# of the client. docs/deployment.md says how to run it, and how to derive an image from it.
#
#   docker build -t envhub-worker .
#
# The base is any image on glibc whose python3 is 3.10 or later and can make virtual environments.
ARG BASE_IMAGE=python:3.12-slim@sha256:78387bc3881b8273120a12ebe6c1ab22b018ccc2c9adf565ae1ac9b536e184ea

FROM ${BASE_IMAGE} AS build
# An environment of its own, where nothing of the base image's is seen.
RUN python3 -m venv /opt/envhub-worker
# What the worker imports, and its --metrics: the group "image" of pyproject.toml, by .ci/lock.sh.
COPY .ci/locks/image.txt /build/
RUN /opt/envhub-worker/bin/python -m pip install --no-cache-dir --only-binary :all: \
        --require-hashes -r /build/image.txt \
    && find /opt/envhub-worker -type d -name tests -prune -exec rm -r {} +
COPY worker/envhub_worker /build/envhub_worker
# Compiled here: nobody can write bytecode into a read-only container.
RUN site=$(/opt/envhub-worker/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))') \
    && cp -r /build/envhub_worker "$site/envhub_worker" \
    && printf '%s\n' '#!/opt/envhub-worker/bin/python -I' 'import sys' \
        'from envhub_worker.__main__ import main' 'sys.exit(main())' \
        >/opt/envhub-worker/bin/envhub-worker \
    && chmod -R u=rwX,go=rX /opt/envhub-worker \
    && chmod 755 /opt/envhub-worker/bin/envhub-worker \
    && /opt/envhub-worker/bin/python -m compileall -q "$site"

FROM ${BASE_IMAGE}
ARG VERSION=0.1.0
ARG REVISION=unknown
LABEL org.opencontainers.image.title="envhub-worker" \
      org.opencontainers.image.description="Executes environments from the Hub under confinement." \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.version="${VERSION}" \
      org.opencontainers.image.revision="${REVISION}"
COPY --from=build /opt/envhub-worker /opt/envhub-worker
# Keys and snapshots of "listen". A volume that is mounted here, new and empty, gets its owner; without
# one, keys last as long as the container, and in a read-only container as long as its start.
RUN install -d -o 65532 -g 65532 -m 0700 /var/lib/envhub-worker
ENV XDG_STATE_HOME=/var/lib \
    PATH=/opt/envhub-worker/bin:/usr/local/bin:/usr/bin:/bin \
    HOME=/tmp \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1
# Nobody's: it owns no file but that folder, so it can change none.
USER 65532:65532
WORKDIR /
EXPOSE 5555
HEALTHCHECK --interval=30s --timeout=10s --start-period=30s \
    CMD ["envhub-worker", "health"]
ENTRYPOINT ["envhub-worker"]
CMD ["listen", "--bind", "tcp://0.0.0.0:5555"]
