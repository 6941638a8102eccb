"""Map background: GeoJSON, or an image with a world file, in WGS 84."""

import json
import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure

from nedbus.errors import ConfigError
from nedbus_msgs.frames import MapProjection

from .style import Style

# suffixes
_WORLD_FILES: Final = {
    ".png": ".pgw",
    ".jpg": ".jgw",
    ".jpeg": ".jgw",
    ".tif": ".tfw",
    ".tiff": ".tfw",
}
_MAX_SIDE: Final = 2000  # pixels; larger images are scaled down
_MAX_PIXELS: Final = 50_000_000  # of an image file; decoded, each takes up to 4 bytes
_PARTS: Final = {
    "FeatureCollection": "features",
    "GeometryCollection": "geometries",
    "Feature": "geometry",
}

Ring = list[tuple[float, float]]


class Background:
    """A background file, read once, and drawn for each viewer once the common origin is known.

    Raises ConfigError if the file is neither GeoJSON nor an image with a world file.
    """

    def __init__(self, path: Path) -> None:
        self.rings: list[Ring] = []  # longitude, latitude [deg]
        self.pixels: Any = None
        self._corners: Ring = []
        try:
            if path.suffix.lower() in _WORLD_FILES:
                self._read_image(path)
            else:
                self.rings = list(_rings(json.loads(path.read_bytes())))
        except OSError as exc:
            raise ConfigError("--map", f"{path}: {(exc.strerror or str(exc)).lower()}") from exc
        except (ValueError, TypeError, LookupError, RecursionError) as exc:
            reason = f"{exc} is missing" if isinstance(exc, KeyError) else str(exc)
            expected = "expected GeoJSON, or an image with a world file, in WGS 84"
            raise ConfigError("--map", f"{path} cannot be drawn ({reason}): {expected}") from exc
        if not self.rings and self.pixels is None:
            raise ConfigError("--map", f"{path} has no lines, polygons or points")

    def draw(self, plot: figure, style: Style, projection: MapProjection) -> None:
        """Draw the background on a map whose axes are metres from the origin of `projection`."""

        def project(longitude: float, latitude: float) -> tuple[float, float]:
            north, east = projection.project(latitude, longitude)
            return east, north

        if self.pixels is not None:
            (west, south), (east, north) = (project(*corner) for corner in self._corners)
            plot.image_rgba(
                [self.pixels], x=west, y=south, dw=east - west, dh=north - south, level="image"
            )
        lines = [
            list(zip(*(project(*point) for point in ring), strict=True)) for ring in self.rings
        ]
        source = ColumnDataSource(
            {"east": [list(east) for east, _ in lines], "north": [list(y) for _, y in lines]}
        )
        plot.multi_line(
            "east",
            "north",
            source=source,
            color=style.colours["quiet"],
            line_width=1.5,
            level="underlay",
        )
        points = [line for line in lines if len(line[0]) == 1]
        easts, norths = [east[0] for east, _ in points], [north[0] for _, north in points]
        plot.scatter(easts, norths, marker="cross", color=style.colours["quiet"], level="underlay")

    def _read_image(self, path: Path) -> None:
        from PIL import Image

        # GDAL writes .wld
        worlds = [path.with_suffix(each) for each in (_WORLD_FILES[path.suffix.lower()], ".wld")]
        world = next((each for each in worlds if each.exists()), None)
        if world is None:
            raise ValueError(
                f"world file {worlds[0].name} not found: create it with gdal_translate -co WORLDFILE=YES"
            )
        width, skew, other_skew, height, west, north = map(float, world.read_text().split()[:6])
        if (
            skew
            or other_skew
            or not (width > 0 > height)
            or not (abs(west) <= 180 and abs(north) <= 90)
        ):
            raise ValueError(
                "the image is not north up in degrees: convert it with gdalwarp -t_srs EPSG:4326"
            )
        too_large = f"more than {_MAX_PIXELS:,} pixels: reduce it with gdal_translate -outsize {_MAX_SIDE} 0"
        warned = Image.DecompressionBombWarning
        try:
            with (
                warnings.catch_warnings(category=warned, action="error"),
                Image.open(path) as image,
            ):
                columns, rows = image.size
                if columns * rows > _MAX_PIXELS:  # before it is decoded
                    raise ValueError(too_large)
                image.thumbnail((_MAX_SIDE, _MAX_SIDE))
                pixels = np.asarray(image.convert("RGBA"))[::-1]
        except (Image.DecompressionBombError, warned) as exc:
            raise ValueError(too_large) from exc
        self.pixels = np.ascontiguousarray(pixels).view(np.uint32).reshape(pixels.shape[:2])
        # the world file has the centre of the first pixel
        left, top = west - width / 2, north - height / 2
        self._corners = [(left, top + rows * height), (left + columns * width, top)]


def _rings(shape: Any) -> Iterator[Ring]:
    """Yield the lines of a GeoJSON object or nested coordinates; a point is a line of length 1."""
    if not shape:
        return
    if isinstance(shape, dict):
        yield from _rings(shape[_PARTS.get(shape["type"], "coordinates")])
    elif isinstance(shape[0], int | float):
        yield [_point_of(shape)]
    elif isinstance(shape[0], list) and isinstance(shape[0][0], int | float):
        yield [_point_of(each) for each in shape]
    else:
        for each in shape:
            yield from _rings(each)


def _point_of(point: Sequence[Any]) -> tuple[float, float]:
    longitude, latitude = float(point[0]), float(point[1])
    if not (math.isfinite(longitude) and abs(latitude) <= 90 and abs(longitude) <= 180):
        raise ValueError(f"{point} is not a longitude and latitude in degrees")
    return longitude, latitude
