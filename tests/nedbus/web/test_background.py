"""The map background: GeoJSON, or an image with a world file, and the errors of both."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from bokeh.plotting import figure
from PIL import Image

from nedbus.errors import ConfigError
from nedbus.web.background import Background
from nedbus.web.style import DARK
from nedbus_msgs.frames import MapProjection

ORIGIN = MapProjection(47.397, 8.545)
RING = [[8.545, 47.397], [8.546, 47.397], [8.546, 47.398], [8.545, 47.397]]
FEATURE = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": RING}}
WORLD = "0.0001 0 0 -0.0001 8.54505 47.39895"
HINT = "expected GeoJSON, or an image with a world file"


def drawn(background: Background) -> Any:
    """Return the first renderer of the drawn background."""
    plot = figure()
    background.draw(plot, DARK, ORIGIN)
    return plot.renderers[0]


@pytest.mark.parametrize(
    ("shape", "lengths"),
    [
        ({"type": "Point", "coordinates": RING[0]}, [1]),
        ({"type": "Point", "coordinates": [*RING[0], 488.0]}, [1]),
        ({"type": "MultiPoint", "coordinates": RING}, [4]),
        ({"type": "LineString", "coordinates": RING}, [4]),
        ({"type": "MultiLineString", "coordinates": [RING, RING]}, [4, 4]),
        ({"type": "Polygon", "coordinates": [RING, RING]}, [4, 4]),
        ({"type": "MultiPolygon", "coordinates": [[RING], [RING, RING]]}, [4, 4, 4]),
        (
            {
                "type": "GeometryCollection",
                "geometries": [{"type": "Point", "coordinates": RING[0]}],
            },
            [1],
        ),
        (
            {
                "type": "FeatureCollection",
                "features": [{"type": "Feature", "geometry": None}, FEATURE],
            },
            [4],
        ),
    ],
    ids=lambda value: value.get("type") if isinstance(value, dict) else "",
)
def test_every_geojson_geometry_is_drawn(tmp_path: Path, shape: object, lengths: list[int]) -> None:
    """Each GeoJSON geometry becomes lines and points in metres from the common origin."""
    file = tmp_path / "field.geojson"
    # with a byte order mark, as Windows editors write
    file.write_text(json.dumps(shape), encoding="utf-8-sig")
    lines = drawn(Background(file)).data_source.data
    assert [len(each) for each in lines["east"]] == lengths
    assert (lines["east"][0][0], lines["north"][0][0]) == pytest.approx((0.0, 0.0), abs=1e-6)


def write_image(folder: Path, *, world: str | None, size: tuple[int, int] = (40, 20)) -> Path:
    """Write a blue image with a red first row, and its world file."""
    file = folder / "field.png"
    image = Image.new("RGB", size, (0, 0, 255))
    image.paste((255, 0, 0), (0, 0, size[0], 1))
    image.save(file)
    if world is not None:
        file.with_suffix(".pgw").write_text("\n".join([*world.split(), ""]))
    return file


@pytest.mark.parametrize("suffix", [".pgw", ".wld"])
def test_image_is_placed_by_its_world_file(tmp_path: Path, suffix: str) -> None:
    """The world file locates the centre of the first pixel; the image is north up, with the northernmost row first."""
    file = write_image(tmp_path, world=WORLD)
    file.with_suffix(".pgw").rename(file.with_suffix(suffix))
    background = Background(file)
    glyph = drawn(background).glyph
    corner = ORIGIN.project(47.399, 8.549)
    assert (glyph.x, glyph.y) == pytest.approx((0.0, 0.0), abs=0.01)
    assert (glyph.y + glyph.dh, glyph.x + glyph.dw) == pytest.approx(corner, abs=0.05)
    assert background.pixels.shape == (20, 40)
    red, blue = 0xFF0000FF, 0xFFFF0000  # little-endian RGBA
    assert (background.pixels[-1, 0], background.pixels[0, 0]) == (red, blue)


def test_large_image_is_scaled_down(tmp_path: Path) -> None:
    """An image sent to the browser has at most 2,000 pixels per side."""
    file = write_image(tmp_path, world=WORLD, size=(5000, 40))
    assert max(Background(file).pixels.shape) == 2000


@pytest.mark.parametrize("pillow_limit", [1000, 900, 400], ids=["accepted", "warning", "error"])
def test_image_above_the_pixel_limit_raises_before_it_is_decoded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pillow_limit: int
) -> None:
    """An image above the limit raises an error with the remedy, even if Pillow would warn about it or refuse it."""
    monkeypatch.setattr("nedbus.limits.MAP_PIXELS", 960)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", pillow_limit)
    file = write_image(tmp_path, world=WORLD, size=(31, 31))
    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", pytest.fail)
    with pytest.raises(ConfigError) as error:
        Background(file)
    assert "more than 960 pixels" in str(error.value)
    assert "gdal_translate -outsize" in str(error.value)


def test_image_at_the_pixel_limit_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An image with as many pixels as the limit is drawn."""
    monkeypatch.setattr("nedbus.limits.MAP_PIXELS", 961)
    assert Background(write_image(tmp_path, world=WORLD, size=(31, 31))).pixels.shape == (31, 31)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (None, "no such file"),
        ("no JSON", HINT),
        ("[]", "has no lines, polygons or points"),
        ('{"type": "Nonsense"}', f"'coordinates' is missing): {HINT}"),
        ('{"type": "Topology", "objects": {}}', HINT),
        ('{"type": "LineString", "coordinates": []}', "has no lines, polygons or points"),
        ('{"type": "LineString", "coordinates": [["a", "b"]]}', HINT),
        ('{"type": "Point", "coordinates": [2600000, 1200000]}', "is not a longitude and latitude"),
        ('{"type": "Point", "coordinates": [NaN, 1]}', "is not a longitude and latitude"),
        ('{"type": "FeatureCollection", "features": []}', "has no lines, polygons or points"),
        ("[" * 2000, HINT),
        ('{"type": "LineString", "coordinates": ' + "[" * 400 + "1" + "]" * 400 + "}", HINT),
    ],
)
def test_invalid_geojson_raises(tmp_path: Path, content: str | None, reason: str) -> None:
    """An invalid background file raises; the error names --map, the file and the accepted formats."""
    file = tmp_path / "field.geojson"
    if content is not None:
        file.write_text(content)
    with pytest.raises(ConfigError) as error:
        Background(file)
    for part in (reason, "--map", str(file)):
        assert part in str(error.value)


@pytest.mark.parametrize(
    ("world", "reason"),
    [
        (None, "world file field.pgw not found"),
        ("0.5 0 0 -0.5 2600000 1200000", "not north up in degrees"),
        ("0.0001 0.1 0.1 -0.0001 8.5 47.3", "not north up in degrees"),
        ("0.0001 0 0 0.0001 8.5 47.3", "not north up in degrees"),
        ("nan 0 0 nan nan nan", "not north up in degrees"),
        ("0.0001 0", HINT),
        ("words", HINT),
        (WORLD, "--map"),
    ],
)
def test_image_without_valid_world_file_raises(
    tmp_path: Path, world: str | None, reason: str
) -> None:
    """An image needs a world file in degrees, north up; the error names the GDAL command that creates one."""
    file = write_image(tmp_path, world=world)
    if world == WORLD:
        file.write_bytes(b"not an image")
    with pytest.raises(ConfigError, match=re.escape(reason)):
        Background(file)
