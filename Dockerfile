# The service and the commands. Zenoh has no wheels for musl: the base must be Debian or another glibc system.
ARG NEDBUS_BASE_IMAGE=python:3.11-slim-bookworm

# Dependencies, which change rarely: exactly the files whose hashes are locked; `make lock` updates them.
FROM ${NEDBUS_BASE_IMAGE} AS dependencies
WORKDIR /build
RUN python3 -m venv /opt/tools && python3 -m venv --without-pip /opt/nedbus
ENV PATH=/opt/tools/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_ONLY_BINARY=:all: PIP_REQUIRE_HASHES=1
COPY packaging/requirements-image.txt ./
RUN pip --python /opt/nedbus install -r requirements-image.txt
COPY packaging/requirements-build.txt ./
RUN pip install -r requirements-build.txt

# nedbus itself, for the same virtual environment, and the SBOM of both; the tools stay in this stage.
FROM dependencies AS code
COPY pyproject.toml README.md LICENSE ./
COPY service service
COPY schemas schemas
COPY packaging packaging
ENV PIP_REQUIRE_HASHES=0 PIP_NO_INDEX=1 PIP_NO_DEPS=1
RUN pip wheel --no-build-isolation --wheel-dir dist . \
    && pip --python /opt/nedbus install --prefix /code dist/nedbus-*.whl \
    && pip --python /opt/nedbus install dist/nedbus-*.whl \
    && packaging/sbom /opt/nedbus /code/sbom.cdx.json

FROM ${NEDBUS_BASE_IMAGE}
# The usual id of a host's first user, whose keys can then be read in the container.
RUN useradd --uid 1000 --create-home nedbus
COPY --from=dependencies /opt/nedbus /opt/nedbus
COPY --from=code /code /opt/nedbus
# Metrics, health and status of `nedbus serve` for other containers, read-only.
ENV PATH=/opt/nedbus/bin:$PATH PYTHONUNBUFFERED=1 NEDBUS_HTTP=0.0.0.0:9464
EXPOSE 9464
# A nedbus.toml mounted here is read.
WORKDIR /etc/nedbus
USER nedbus
HEALTHCHECK --interval=30s --timeout=5s CMD ["nedbus", "health"]
ENTRYPOINT ["nedbus"]
CMD ["serve"]
