"""A bundle for a vehicle: its certificate, its key, and the configuration that uses them, ready to be copied there."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from nedbus.errors import ConfigError, PkiError
from nedbus.whole_file import whole_file

from .access_rules import certificate_name
from .endpoints import check_endpoints
from .pki import DAYS, Authority, new_key, write_certificate, write_secret

TARGET: Final = Path("/etc/nedbus")
"""Where the files of a bundle are on the vehicle: where the unit and the image look for nedbus.toml."""

_SETTINGS: Final = """\
# Settings of `nedbus serve` on vehicle {vehicle}; README.txt beside this file says where it belongs.
connect = {routers}
tls_ca = {ca}
tls_certificate = {certificate}
tls_key = {key}

# The router accepts no other vehicle with this certificate.
vehicle = {name}

# What the service publishes.
{source}

# For programs on the vehicle that read, also while the link to the router is down, and for `px4-zenoh:`, whose PX4
# connects here; 0.0.0.0 in place of 127.0.0.1 lets in other computers, which may write as this vehicle.
# listen = ["tcp/127.0.0.1:7447"]
"""
_NO_SOURCE: Final = """\
# Choose one, and remove the # before it; until then the service does not start.
# source = ["mavlink:udpin:0.0.0.0:14540?vehicles=1:{vehicle}"]  # 1 is the autopilot's MAV_SYS_ID
# source = ["px4-zenoh:"]  # with `listen` below
# source = ["sim:"]  # a simulated vehicle, to try the connection"""
_COMPOSE: Final = """\
# The service of vehicle {vehicle}, for a computer with Docker; README.txt beside this file says how it is started.
services:
  nedbus:
    image: ${{NEDBUS_IMAGE:-nedbus}}
    init: true
    restart: unless-stopped
    user: "${{NEDBUS_USER:-1000:1000}}" # who may read the key: $(id -u):$(id -g) of the owner of these files
    network_mode: host # the autopilot's packets arrive at the host
    environment:
      NEDBUS_HTTP: "${{NEDBUS_HTTP:-127.0.0.1:9464}}" # metrics and health, for this host only
    working_dir: {target}
    volumes: # the folder, so that a file that is replaced is seen
      - {{ type: bind, source: ., target: {target}, read_only: true }}
    read_only: true
    cap_drop: [ALL]
    security_opt: ["no-new-privileges:true"]
"""
_README: Final = """\
Files for vehicle {vehicle}. The certificate is valid until {until}.

pki/{common_name}.key is secret: copy this folder over a channel that nobody else reads (scp, a USB stick), and remove
it everywhere but on the vehicle.

1. In nedbus.toml, set `source`: what this vehicle publishes.

2. Either with Docker, where the image `nedbus` is (on a computer that has built it: docker save nedbus | ssh VEHICLE
   docker load), as the owner of these files, in this folder:

       echo "NEDBUS_USER=$(id -u):$(id -g)" > .env
       docker compose up -d

   After a change of nedbus.toml:

       docker compose restart

   Or with systemd, where nedbus and its unit are installed (docs/systemd.md), in this folder:

       sudo install -d -g nedbus -m 750 {pki}
       sudo install -g nedbus -m 640 pki/ca.crt pki/{common_name}.crt pki/{common_name}.key {pki}/
       sudo install -g nedbus -m 640 nedbus.toml /etc/nedbus/
       sudo systemctl enable nedbus
       sudo systemctl restart nedbus

3. The router has to know vehicle {vehicle}. Where its file is, this writes the rules, or says that they are there;
   the router takes new ones when it starts again:

       nedbus pki rules router-secure.json5 --add {vehicle}

4. See that it arrives, on a computer with a reader's certificate:

       nedbus health --vehicle {vehicle} --connect {router} \\
           --tls-ca pki/ca.crt --tls-certificate pki/reader.crt --tls-key pki/reader.key

   Where it does not, `nedbus doctor` says why: there with the same options, and on the vehicle, which may write and not
   read, with `docker compose exec nedbus nedbus doctor --vehicle {vehicle}`, or without Docker, in /etc/nedbus, with
   `sudo -u nedbus /opt/nedbus/bin/nedbus doctor --vehicle {vehicle}`.

Before the certificate ends, `nedbus pki renew` makes {common_name}.crt anew: copy that one file over the old one, with
Docker in the folder pki beside this file, with systemd:

       sudo install -g nedbus -m 640 {common_name}.crt {pki}/

The key stays, and nothing has to be restarted: the file is read at the next connection, at the latest when the old
certificate ends.
"""


def make_bundle(
    folder: Path,
    vehicle: str,
    output: Path,
    *,
    routers: Sequence[str],
    sources: Sequence[str] = (),
    target: Path = TARGET,
    days: int = DAYS,
) -> list[Path]:
    """Make a folder of all that a vehicle needs to join these routers, whole or not at all, and return its files.

    The authority's folder keeps the certificate, to be listed and renewed; the key is in the bundle only.
    `target` is where the files will be on the vehicle.

    Raises PkiError when the folder, or a key or certificate of this vehicle, exists already; ConfigError for an
    endpoint that is not tls/, AddressError for what is no vehicle.
    """
    name = certificate_name(vehicle)
    check_endpoints(routers, where="--router")
    for router in routers:
        if not router.startswith("tls/"):
            raise ConfigError("--router", f"{router!r} shows no certificate: name a tls/ endpoint")
    if not routers:
        raise ConfigError("--router", "name at least one router, such as tls/192.168.1.5:7447")
    authority = Authority.read(folder)
    for path in (output, folder / f"{name}.key", folder / f"{name}.crt"):
        if path.exists():
            raise PkiError(f"{path} exists: it is not overwritten; 'nedbus pki list' says until when it is valid")
    key = new_key()
    certificate = authority.sign(name, key.public_key(), days=days)
    part = output.with_name(f".{os.getpid()}-part-{output.name}")
    until = f"{certificate.not_valid_after_utc:%Y-%m-%d}"
    facts = {"vehicle": vehicle, "common_name": name, "pki": f"{target}/pki", "until": until, "router": routers[0]}
    try:
        with whole_file(folder / f"{name}.crt") as kept:
            write_certificate(kept, certificate)
            (part / "pki").mkdir(parents=True)
            (part / "pki").chmod(0o700)
            write_secret(part / "pki" / f"{name}.key", key)
            write_certificate(part / "pki" / f"{name}.crt", certificate)
            write_certificate(part / "pki" / "ca.crt", authority.certificate)
            (part / "nedbus.toml").write_text(_settings(facts, routers, sources))
            (part / "compose.yml").write_text(_COMPOSE.format(vehicle=vehicle, target=json.dumps(str(target))))
            (part / "README.txt").write_text(_README.format(**facts))
            part.rename(output)
    except OSError as exc:
        raise PkiError(f"{output} cannot be made: {(exc.strerror or str(exc)).lower()}") from exc
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return sorted(path for path in output.rglob("*") if path.is_file())


def _settings(facts: Mapping[str, str], routers: Sequence[str], sources: Sequence[str]) -> str:
    """Return the content of nedbus.toml; a string of JSON is one of TOML."""
    pki = facts["pki"]
    return _SETTINGS.format(
        vehicle=facts["vehicle"],
        name=json.dumps(facts["vehicle"]),
        routers=json.dumps(list(routers)),
        ca=json.dumps(f"{pki}/ca.crt"),
        certificate=json.dumps(f"{pki}/{facts['common_name']}.crt"),
        key=json.dumps(f"{pki}/{facts['common_name']}.key"),
        source=f"source = {json.dumps(list(sources))}" if sources else _NO_SOURCE.format(**facts),
    )
