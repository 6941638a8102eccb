"""Map background: GeoJSON, or an image with a world file, in WGS 84."""

import json
import math
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from bokeh.models import ColumnDataSource
from bokeh.plotting import figure

from nedbus import limits
from nedbus.errors import ConfigError, system_reason
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
_SIDE: Final = 2000  # pixels; larger images are scaled down to it
_PARTS: Final = {
    "FeatureCollection": "features",
    "GeometryCollection": "geometries",
    "Feature": "geometry",
}


class Point(NamedTuple):
    """A position [deg]."""

    longitude: float
    latitude: float


Ring = list[Point]


class Background:
    """A background file, read once, and drawn for each viewer once the common origin is known.

    Raises ConfigError if the file is neither GeoJSON nor an image with a world file.
    """

    def __init__(self, path: Path) -> None:
        self.rings: list[Ring] = []
        self.pixels: Any = None
        self._corners: Ring = []  # south-west and north-east
        try:
            if path.suffix.lower() in _WORLD_FILES:
                self._read_image(path)
            else:
                self.rings = list(_rings(json.loads(path.read_bytes())))
        except OSError as exc:
            raise ConfigError("--map", f"{path}: {system_reason(exc)}") from exc
        except (ValueError, TypeError, LookupError, RecursionError) as exc:
            if isinstance(exc, KeyError):
                reason = f"{exc} is missing"
            else:
                reason = str(exc)
            expected = "expected GeoJSON, or an image with a world file, in WGS 84"
            raise ConfigError("--map", f"{path} cannot be drawn ({reason}): {expected}") from exc
        if not self.rings and self.pixels is None:
            raise ConfigError("--map", f"{path} has no lines, polygons or points")

    def draw(self, plot: figure, style: Style, projection: MapProjection) -> None:
        """Draw the background on a map whose axes are metres from the origin of `projection`."""
        colour = style.colours["quiet"]

        def project(point: Point) -> tuple[float, float]:
            north, east = projection.project(point.latitude, point.longitude)
            return east, north

        if self.pixels is not None:
            west, south = project(self._corners[0])
            east, north = project(self._corners[1])
            plot.image_rgba(
                [self.pixels], x=west, y=south, dw=east - west, dh=north - south, level="image"
            )
        easts = []
        norths = []
        points = []
        for ring in self.rings:
            line = [project(point) for point in ring]
            easts.append([east for east, _ in line])
            norths.append([north for _, north in line])
            if len(line) == 1:
                points.append(line[0])
        source = ColumnDataSource({"east": easts, "north": norths})
        plot.multi_line(
            "east", "north", source=source, color=colour, line_width=1.5, level="underlay"
        )
        plot.scatter(
            [east for east, _ in points],
            [north for _, north in points],
            marker="cross",
            color=colour,
            level="underlay",
        )

    def _read_image(self, path: Path) -> None:
        from PIL import Image

        left, top, width, height = _read_world_file(path)
        remedy = f"reduce it with gdal_translate -outsize {_SIDE} 0"
        too_large = f"more than {limits.MAP_PIXELS:,} pixels: {remedy}"
        warned = Image.DecompressionBombWarning
        try:
            with (
                warnings.catch_warnings(category=warned, action="error"),
                Image.open(path) as image,
            ):
                columns, rows = image.size
                if columns * rows > limits.MAP_PIXELS:  # before it is decoded
                    raise ValueError(too_large)
                image.thumbnail((_SIDE, _SIDE))
                rgba = np.asarray(image.convert("RGBA"))
        except (Image.DecompressionBombError, warned) as exc:
            raise ValueError(too_large) from exc
        pixels = np.ascontiguousarray(rgba[::-1])  # Bokeh draws the first row at the bottom
        self.pixels = pixels.view(np.uint32).reshape(pixels.shape[:2])
        south_west = Point(left, top - rows * height)
        north_east = Point(left + columns * width, top)
        self._corners = [south_west, north_east]


def _read_world_file(path: Path) -> tuple[float, float, float, float]:
    """Return the west and north border of an image, and the width and height of a pixel [deg]."""
    suffix = _WORLD_FILES[path.suffix.lower()]
    world = path.with_suffix(suffix)
    if not world.exists():
        world = path.with_suffix(".wld")  # as GDAL writes
    if not world.exists():
        name = path.with_suffix(suffix).name
        raise ValueError(
            f"world file {name} not found: create it with gdal_translate -co WORLDFILE=YES"
        )
    width, skew, other_skew, step, west, north = map(float, world.read_text().split()[:6])
    is_north_up = not skew and not other_skew and width > 0 > step
    is_in_degrees = abs(west) <= 180 and abs(north) <= 90
    if not is_north_up or not is_in_degrees:
        raise ValueError(
            "the image is not north up in degrees: convert it with gdalwarp -t_srs EPSG:4326"
        )
    # the world file has the centre of the first pixel
    return west - width / 2, north - step / 2, width, -step


def _rings(shape: Any) -> Iterator[Ring]:
    """Yield the lines of a GeoJSON object or nested coordinates; a point is a line of length 1."""
    if not shape:
        return
    if isinstance(shape, dict):
        yield from _rings(shape[_PARTS.get(shape["type"], "coordinates")])
    elif isinstance(shape[0], int | float):
        yield [_point_of(shape)]
    elif isinstance(shape[0], list) and isinstance(shape[0][0], int | float):
        yield [_point_of(point) for point in shape]
    else:
        for part in shape:
            yield from _rings(part)


def _point_of(point: Sequence[Any]) -> Point:
    longitude = float(point[0])
    latitude = float(point[1])
    if not (math.isfinite(longitude) and abs(latitude) <= 90 and abs(longitude) <= 180):
        raise ValueError(f"{point} is not a longitude and latitude in degrees")
    return Point(longitude, latitude)
