# The service and the commands. Zenoh has no wheels for musl: the base must be Debian or another glibc system.
ARG NEDBUS_BASE_IMAGE=python:3.11-slim-bookworm

# What changes seldom: everything that nedbus depends on, for which an empty nedbus is enough.
FROM ${NEDBUS_BASE_IMAGE} AS dependencies
RUN python3 -m venv /opt/nedbus
WORKDIR /build
COPY pyproject.toml LICENSE ./
RUN mkdir -p service/nedbus schemas/nedbus_msgs packaging/fleet \
    && echo '__version__ = "0"' > service/nedbus/__init__.py \
    && touch schemas/nedbus_msgs/__init__.py README.md \
    && /opt/nedbus/bin/pip install --no-cache-dir ".[mavlink,mcap,metrics,pki,web]" \
    && /opt/nedbus/bin/pip uninstall -y nedbus

# What changes often: nedbus itself, as files for the same virtual environment.
FROM dependencies AS code
COPY README.md ./
COPY service service
COPY schemas schemas
COPY packaging/fleet packaging/fleet
RUN /opt/nedbus/bin/pip install --no-cache-dir --no-deps --prefix /code .

FROM ${NEDBUS_BASE_IMAGE}
# The usual id of a host's first user: keys that this user made can be read inside as well.
RUN useradd --uid 1000 --create-home nedbus
COPY --from=dependencies /opt/nedbus /opt/nedbus
COPY --from=code /code /opt/nedbus
# Metrics, health and status of `nedbus serve`, for other containers: nothing can be changed there.
ENV PATH=/opt/nedbus/bin:$PATH PYTHONUNBUFFERED=1 NEDBUS_HTTP=0.0.0.0:9464
EXPOSE 9464
# A nedbus.toml mounted here is read.
WORKDIR /etc/nedbus
USER nedbus
HEALTHCHECK --interval=30s --timeout=5s CMD ["nedbus", "health"]
ENTRYPOINT ["nedbus"]
CMD ["serve"]
