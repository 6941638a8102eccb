"""The layer under the tracks of the page: GeoJSON, or a picture with a world file, and errors of both."""

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

PLACE = MapProjection(47.397, 8.545)
RING = [[8.545, 47.397], [8.546, 47.397], [8.546, 47.398], [8.545, 47.397]]
FEATURE = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": RING}}
WORLD = "0.0001 0 0 -0.0001 8.54505 47.39895"
HINT = "expected GeoJSON, or a picture with a world file"


def drawn(background: Background) -> Any:
    """Return what is drawn first."""
    plot = figure()
    background.draw(plot, DARK, PLACE)
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
        ({"type": "GeometryCollection", "geometries": [{"type": "Point", "coordinates": RING[0]}]}, [1]),
        ({"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": None}, FEATURE]}, [4]),
    ],
    ids=lambda value: value.get("type") if isinstance(value, dict) else "",
)
def test_every_kind_of_geojson_is_drawn(tmp_path: Path, shape: object, lengths: list[int]) -> None:
    """Each geometry of GeoJSON becomes lines and points in metres from the common origin."""
    file = tmp_path / "field.geojson"
    file.write_text(json.dumps(shape), encoding="utf-8-sig")  # with the byte order mark of editors on Windows
    lines = drawn(Background(file)).data_source.data
    assert [len(each) for each in lines["east"]] == lengths
    assert (lines["east"][0][0], lines["north"][0][0]) == pytest.approx((0.0, 0.0), abs=1e-6)


def picture(folder: Path, *, world: str | None, size: tuple[int, int] = (40, 20)) -> Path:
    """Write a picture whose first row is red, and its world file."""
    file = folder / "field.png"
    image = Image.new("RGB", size, (0, 0, 255))
    image.paste((255, 0, 0), (0, 0, size[0], 1))
    image.save(file)
    if world is not None:
        file.with_suffix(".pgw").write_text("\n".join([*world.split(), ""]))
    return file


@pytest.mark.parametrize("suffix", [".pgw", ".wld"])
def test_picture_lies_where_its_world_file_says(tmp_path: Path, suffix: str) -> None:
    """The first pixel's centre is in the world file; the picture is north up, its first row in the north."""
    file = picture(tmp_path, world=WORLD)
    file.with_suffix(".pgw").rename(file.with_suffix(suffix))
    background = Background(file)
    glyph = drawn(background).glyph
    corner = PLACE.project(47.399, 8.549)
    assert (glyph.x, glyph.y) == pytest.approx((0.0, 0.0), abs=0.01)
    assert (glyph.y + glyph.dh, glyph.x + glyph.dw) == pytest.approx(corner, abs=0.05)
    assert background.pixels.shape == (20, 40)
    red, blue = 0xFF0000FF, 0xFFFF0000  # little-endian RGBA
    assert (background.pixels[-1, 0], background.pixels[0, 0]) == (red, blue)


def test_large_picture_is_made_smaller(tmp_path: Path) -> None:
    """A browser gets at most 2,000 pixels a side, over the same ground."""
    file = picture(tmp_path, world=WORLD, size=(5000, 40))
    assert max(Background(file).pixels.shape) == 2000


@pytest.mark.parametrize(
    ("content", "said"),
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
        ("[" * 100_000, HINT),
        ('{"type": "LineString", "coordinates": ' + "[" * 400 + "1" + "]" * 400 + "}", HINT),
    ],
)
def test_file_that_is_no_map_is_named(tmp_path: Path, content: str | None, said: str) -> None:
    """A map that cannot be drawn is an error of --map that names the file and the accepted ones."""
    file = tmp_path / "field.geojson"
    if content is not None:
        file.write_text(content)
    with pytest.raises(ConfigError) as error:
        Background(file)
    for part in (said, "--map", str(file)):
        assert part in str(error.value)


@pytest.mark.parametrize(
    ("world", "said"),
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
def test_picture_without_its_place_is_named(tmp_path: Path, world: str | None, said: str) -> None:
    """A picture needs a world file in degrees, north up, and to be one; the error says how to make one."""
    file = picture(tmp_path, world=world)
    if world == WORLD:
        file.write_bytes(b"no picture")
    with pytest.raises(ConfigError, match=re.escape(said)):
        Background(file)
