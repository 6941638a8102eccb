"""Bundle of a vehicle: certificate, key and configuration in one folder, ready to copy to the vehicle."""

import json
import os
import shutil
import string
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from nedbus.atomic_write import atomic_write
from nedbus.endpoints import check_endpoints
from nedbus.errors import ConfigError, PkiError, system_reason

from .authority import Authority, new_key, write_new
from .certificate import certificate_name

_TARGET: Final = Path("/etc/nedbus")  # where the systemd unit and the image expect nedbus.toml
_IN_WHEEL: Final = Path(__file__).with_name("fleet")
_TEMPLATES: Final = (
    _IN_WHEEL if _IN_WHEEL.is_dir() else Path(__file__).parents[3] / "packaging" / "fleet"
)


class _Template(string.Template):
    delimiter = "@"  # the shell and Docker use $


def make_bundle(
    folder: Path,
    vehicle: str,
    output: Path,
    *,
    routers: Sequence[str],
    sources: Sequence[str] = (),
    target: Path | None = None,
    days: int | None = None,
) -> list[Path]:
    """Atomically create a folder with all files that a vehicle needs to join these routers, and return the files.

    `folder`: the CA's folder, which keeps a copy of the certificate for renewal; the key is only in the bundle.
    `target`: folder of the files on the vehicle, by default /etc/nedbus.

    Raises PkiError if the output folder, or a key or certificate of this vehicle, already exists; ConfigError for an
    endpoint other than tls/; AddressError for an invalid vehicle.
    """
    name = certificate_name(vehicle)
    check_endpoints(routers, where="--router")
    for router in routers:
        if not router.startswith("tls/"):
            raise ConfigError("--router", f"{router!r} does not use TLS: use a tls/ endpoint")
    if not routers:
        raise ConfigError("--router", "specify at least one router, such as tls/192.168.1.5:7447")
    authority = Authority.read(folder)
    for path in (output, folder / f"{name}.key", folder / f"{name}.crt"):
        if path.exists():
            raise PkiError(
                f"{path} exists and is not overwritten: move it away to enroll {name} again"
            )
    key = new_key()
    certificate = authority.sign(name, key.public_key(), days=days)
    target = target or _TARGET
    strings = {  # written as JSON strings, which are valid in TOML and YAML
        "routers": list(routers),
        "ca": f"{target}/pki/ca.crt",
        "certificate": f"{target}/pki/{name}.crt",
        "key": f"{target}/pki/{name}.key",
        "name": vehicle,
        "target": str(target),
    }
    source = ""
    if sources:
        source = f"source = {json.dumps(list(sources))}\n"
    values = {field: json.dumps(value) for field, value in strings.items()} | {
        "vehicle": vehicle,
        "common_name": name,
        "pki": f"{target}/pki",
        "router": routers[0],
        "source": source,
        "until": f"{certificate.not_valid_after_utc:%Y-%m-%d}",
    }
    temporary = output.with_name(f".{os.getpid()}-part-{output.name}")
    try:
        with atomic_write(folder / f"{name}.crt") as copy:
            write_new(copy, certificate)
            (temporary / "pki").mkdir(parents=True)
            (temporary / "pki").chmod(0o700)
            for file, item in (
                (f"{name}.key", key),
                (f"{name}.crt", certificate),
                ("ca.crt", authority.certificate),
            ):
                write_new(temporary / "pki" / file, item)
            for file in ("nedbus.toml", "compose.yml", "README.txt"):
                (temporary / file).write_text(
                    _Template((_TEMPLATES / file).read_text()).substitute(values)
                )
            temporary.rename(output)
    except OSError as exc:
        raise PkiError(f"cannot create {output}: {system_reason(exc)}") from exc
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return sorted(path for path in output.rglob("*") if path.is_file())
