"""README and docs: every snippet is run or at least checked, and the reference lists every name of the code."""

from __future__ import annotations

import ast
import configparser
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Final

import pytest
from benchmarks.compare.report import SHOWN
from pymavlink.dialects.v20 import common as mavlink

import nedbus
from docs.generator import DOCS
from docs.generator.api import PUBLIC_MODULES, api_page
from docs.generator.commands import commands, commands_page
from docs.generator.metrics import metrics_page
from docs.generator.tables import events_page, keys_page, limits_page, settings_page
from nedbus.health import StreamHealth
from nedbus.log_event import EVENTS
from nedbus.mavlink.fields import CONVERSIONS
from nedbus.monitoring.metrics import METRICS
from nedbus.settings import Settings
from nedbus.sources import SOURCE_KINDS, parse_source
from nedbus.timings import TIMINGS
from nedbus.transport import open_router
from nedbus.vehicle_events import KINDS
from nedbus_msgs import MESSAGES, TOPICS, VehicleLocalPosition
from tests.documents import (
    BLOCKS,
    PAGES,
    ROOT,
    Block,
    check_options,
    installed_packages,
    nedbus_commands,
    needed_packages,
    parse_command,
    shape_of,
)
from tests.flights.replays import convert_replay
from tests.nedbus.cli.commands.test_events import write_flight
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint, free_port
from tests.peers.processes import ForkServer, Process, Start, without_coverage
from tests.waits import wait_for

SERVERS: Final = ("serve", "router", "export", "web", "foxglove", "ros2")
ENDLESS: Final = (*SERVERS, "echo", "hz", "events")
CHECKS: Final = ("health", "doctor")  # may exit with 1
RUN_IN_FOLDER: Final = (
    "import os, runpy, sys; "
    "os.chdir(sys.argv.pop(1)); runpy.run_module('nedbus', run_name='__main__')"
)
NAMES: Final = dict(commands())
SHELLS: Final = [block for block in BLOCKS if block.language in ("bash", "sh")]
TEXTS: Final = {page: page.read_text() for page in PAGES}
ALL: Final = "".join(TEXTS.values())
# these load a link to 40 %
FEW_TOPICS: Final = (
    "&topics=vehicle_local_position,sensor_gps,battery_status,vehicle_status,home_position"
)
VEHICLES: Final = ((1, ""), (2, FEW_TOPICS), (7, FEW_TOPICS))
DATA: Final = ("toml", "json", "ini", "python")
PYTHON: Final = [block for block in BLOCKS if block.language == "python"]


@pytest.fixture(scope="module")
def vehicles(fork_server: ForkServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Run a router with the vehicles of the pages, for all snippets that only subscribe."""
    endpoint = free_endpoint()
    router = open_router(listen=(endpoint,))
    sources = [
        text
        for vehicle, topics in VEHICLES
        for text in ("--source", f"sim:?vehicle={vehicle}{topics}")
    ]
    command = (sys.executable, "-m", "nedbus", "serve", "--connect", endpoint, *sources)
    environment = {
        name: value for name, value in without_coverage().items() if not name.startswith("NEDBUS_")
    }
    service = Process(command, tmp_path_factory.mktemp("vehicles"), environment, fork_server)
    with nedbus.connect(endpoint) as bus:
        wait_for(lambda: len(bus.latest("*")) == 12 + 2 * 5, what="three vehicles")
    yield endpoint
    service.kill()
    router.close()


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make the files that the pages mention: a recording, and a log with a fault."""
    folder = tmp_path_factory.mktemp("flights")
    convert_replay("sim:?duration=40", folder / "flight.mcap")
    write_flight(folder / "flight.ulg")
    return folder


@pytest.fixture
def snippet_folder(flights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Change to a folder with copies of these files, like a clone."""
    folder = tmp_path / "clone"
    shutil.copytree(flights, folder)
    for name in ("config", "examples"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "nedbus.toml").write_text('source = ["sim:"]\n')
    outline = {
        "type": "Polygon",
        "coordinates": [[[8.5, 47.3], [8.6, 47.3], [8.6, 47.4], [8.5, 47.3]]],
    }
    (folder / "field.geojson").write_text(json.dumps(outline))
    (folder / "field.png").touch()
    monkeypatch.chdir(folder)
    return folder


def missing_lines(shown: Iterable[str], printed: str) -> list[str]:
    """Return the shown lines without a printed line of the same shape."""
    lines = [line.strip() for line in printed.splitlines()]
    return [
        line for line in shown if line != "..." and not any(map(shape_of(line).fullmatch, lines))
    ]


class Runner:
    """Run snippets with the vehicles of this test instead of the user's."""

    def __init__(self, start: Start, endpoint: str, folder: Path) -> None:
        self._start, self._endpoint, self._folder = start, endpoint, folder
        self._environment = {
            "NEDBUS_CONNECT": endpoint,
            "PYTHONUNBUFFERED": "1",
            "MPLBACKEND": "agg",
        }

    def run(self, block: Block, *, shown: Iterable[str] = ()) -> str:
        """Run a snippet and return its stdout; a script is stopped once it has printed the shown lines."""
        for made in re.findall(r"--output (\S+)", block.text):
            (self._folder / made).unlink(missing_ok=True)
        if block.language == "python":
            return self._run_python(block, shown)
        if block.is_plain:
            return "".join(map(self._run_command, block.commands))
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        done = subprocess.run(
            ["bash", "-e", "-c", self._localize(block.text)],
            cwd=self._folder,
            env=os.environ | self._environment | {"PATH": path},
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )
        assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
        return done.stdout

    def _localize(self, text: str) -> str:
        for pattern, local in (
            (r"(--connect |connect\(\")tcp/192\.168\.1\.[56]:7447", rf"\1{self._endpoint}"),
            (r"tcp/(?:0\.0\.0\.0|127\.0\.0\.1):7447", free_endpoint()),
            (r"(udpin:|--http )(?:0\.0\.0\.0|127\.0\.0\.1):\d+", rf"\g<1>127.0.0.1:{free_port()}"),
        ):
            text = re.sub(pattern, local, text)
        return text

    def _run_command(self, command: str) -> str:
        """Run a nedbus command to its end; send Ctrl-C to an endless one after its first output."""
        arguments = shlex.split(self._localize(command))[1:]
        name = next(each for each in arguments if f"nedbus {each}" in NAMES)
        if name == "router":
            arguments += ["--listen", free_endpoint()]
        if name in {"web", "foxglove"} and "--http" not in arguments:
            arguments += ["--http", f"127.0.0.1:{free_port()}"]
        process = self._start(
            "-c", RUN_IN_FOLDER, str(self._folder), *arguments, coverage=False, **self._environment
        )
        wait_for(
            lambda: self._has_output(process) or process.popen.poll() is not None, what=command
        )
        ends = bool({"--duration", "--check"} & {*arguments}) or (
            name == "events" and "flight.ulg" in arguments
        )
        if name in ENDLESS and not ends:
            process.signal(signal.SIGINT)
        code = process.wait(60)
        assert code in {0, 130, *([1] * (name in CHECKS))}, f"{command}: {process.err}"
        assert "Traceback" not in process.err
        return process.out

    @staticmethod
    def _has_output(process: Process) -> bool:
        return bool(
            process.out
            or " router on " in process.err
            or re.search("connecting to|http|ws:|->", process.err)
        )

    def _run_python(self, block: Block, shown: Iterable[str]) -> str:
        """Run a script until it ends, or has printed three lines and all shown lines."""
        blocks = [each for each in PYTHON if each.page == block.page]
        texts: list[str] = []
        for each in reversed(blocks[: blocks.index(block) + 1]):
            texts.insert(0, each.text)
            if each.marker != "continues":
                break
        script = self._folder / "script.py"
        script.write_text(
            self._localize("\n".join([f"import os; os.chdir({str(self._folder)!r})", *texts]))
        )
        process = self._start(str(script), coverage=False, **self._environment)

        def is_done() -> bool:
            has_printed = process.out.count("\n") >= 3 and not missing_lines(shown, process.out)
            return has_printed or process.popen.poll() is not None

        wait_for(is_done, what=f"{block}: {process.err}")
        if process.popen.poll() is None:
            process.signal(signal.SIGINT)
            process.wait()
            assert not process.err or process.err.rstrip(": \n").endswith("KeyboardInterrupt"), (
                process.err
            )
        else:
            assert process.wait() == 0, process.err
        return process.out


@pytest.fixture
def runner(start: Start, vehicles: str, snippet_folder: Path) -> Runner:
    """Return a runner of snippets in the folder of the files, with the vehicles."""
    return Runner(start, vehicles, snippet_folder)


@pytest.mark.slow
@pytest.mark.parametrize("block", [each for each in (*SHELLS, *PYTHON) if each.is_run], ids=str)
def test_snippet_runs(runner: Runner, block: Block) -> None:
    """Every snippet that is not marked `not run` or `run by` ends without an error."""
    runner.run(block)


@pytest.mark.slow
@pytest.mark.parametrize("block", [each for each in BLOCKS if each.marker == "output"], ids=str)
def test_shown_output_is_printed(runner: Runner, block: Block) -> None:
    """The snippet above prints each shown line, possibly with other numbers."""
    shown = block.text.splitlines()
    assert missing_lines(shown, runner.run(BLOCKS[BLOCKS.index(block) - 1], shown=shown)) == []


@pytest.mark.parametrize("block", [each for each in BLOCKS if not each.is_run], ids=str)
def test_snippet_that_is_not_run_has_a_reason(block: Block) -> None:
    """A snippet that test_documents does not run has a reason, or names the test that runs it."""
    assert len(block.reason) > 10
    for file in re.findall(r"tests/\S+\.py", block.reason):
        assert (ROOT / file).is_file()
    if block.marker == "run by":
        assert block.page.stem in (ROOT / block.reason).read_text()


def test_every_block_has_a_known_language_and_marker() -> None:
    """Every code block has a language and a marker that these tests handle."""
    languages = {block.language for block in BLOCKS} - {"{toctree}"}
    assert languages <= {
        "bash",
        "sh",
        "python",
        "toml",
        "json",
        "ini",
        "text",
        "javascript",
        "rust",
        "cpp",
        "go",
        "java",
    }
    assert {block.marker for block in BLOCKS} <= {"", "not run", "run by", "continues", "output"}
    assert not [str(block) for block in SHELLS if block.language == "sh" and block.is_run]
    assert sum(text.count("```") for text in TEXTS.values()) == 2 * len(BLOCKS)


def test_payload_indices_are_correct_in_each_language() -> None:
    """The snippets in other languages use the correct payload indices: 0 is the layout, then the fields in order."""
    text = TEXTS[ROOT / "docs" / "other-languages.md"]
    names = ["layout", *VehicleLocalPosition.model_fields]
    [(rust, indices)] = re.findall(r"let \((.*)\) = \((.*)\);", text)
    assert [names[int(each)] for each in re.findall(r"\[(\d+)\]", indices)] == rust.split(", ")
    [pattern] = re.findall(r"const \[(.*)\] = decode", text)
    camel = {"xyValid": "xy_valid", "zValid": "z_valid"}
    for index, name in enumerate(pattern.split(",")):
        assert camel.get(name.strip(), name.strip()) in ("", names[index])
    for name, position in re.findall(r'" (\w) " << message.at\((\d+)\)', text):
        assert names[int(position)] == name
    written = {
        name: max(each.wire or 0 for each in known.layouts.values())
        for name, known in MESSAGES.items()
    }
    assert {name for name, number in written.items() if number} == {"VehicleLocalPosition"}, (
        "layout 1; all others have 0"
    )
    assert written["VehicleLocalPosition"] == 1


@pytest.mark.process
@pytest.mark.parametrize("block", SHELLS, ids=str)
def test_shell_snippet_is_valid(snippet_folder: Path, block: Block) -> None:
    """Every shell snippet parses, and the options of its nedbus commands, its sources and its files exist."""
    subprocess.run(["bash", "-n", "-c", block.text], check=True, timeout=30)
    for command in nedbus_commands(block):
        parse_command(command)
    for source in re.findall(r"--source \"?([^\s\"]+)", block.text):
        parse_source(source)
    for file in re.findall(r"(?:config|packaging|examples)/[\w./-]+\.\w+", block.text):
        assert (ROOT / file).is_file()
    for module in re.findall(r"python -m (benchmarks\.\w+)", block.text):
        assert (ROOT / f"{module.replace('.', '/')}.py").is_file()
    makefile = (ROOT / "Makefile").read_text()
    for target in re.findall(r"^make (\w+)", block.text, re.MULTILINE):
        assert f"\n{target}:" in makefile or target.startswith("px4_")


@pytest.mark.parametrize("block", [each for each in BLOCKS if each.language in DATA], ids=str)
def test_data_snippet_is_valid(block: Block, tmp_path: Path) -> None:
    """Settings pass `nedbus check`; JSON, Python and drop-ins of units parse."""
    if block.language == "toml":
        (tmp_path / "nedbus.toml").write_text(block.text)
        others = {} if "source" in block.text else {"NEDBUS_SOURCE": "sim:"}
        checked = run_command("check", "--offline", str(tmp_path / "nedbus.toml"), **others)
        assert checked.exit_code == 0, checked.err
    elif block.language == "json":
        assert [json.loads(line) for line in block.text.splitlines()]
    elif block.language == "ini":
        configparser.ConfigParser().read_string(block.text)
    else:
        ast.parse(block.text)


def test_mentioned_names_and_commands_exist() -> None:
    """Every `nedbus.NAME` in a text is public, and every command in a sentence exists with its options."""
    names = set(
        re.findall(
            r"\bnedbus\.([A-Za-z]\w*)(?!.*\")", re.sub(r"^\{.*", "", ALL, flags=re.MULTILINE)
        )
    )
    assert names - {"toml", "json", "yml", "service", "mcap"} <= {*dir(nedbus)}
    for command in re.findall(r"`(nedbus [a-z][^`]*)`", ALL):
        if "COMMAND" not in command:
            check_options(command)


def test_first_script_is_the_example() -> None:
    """The first script of the README is examples/position.py, which the tests run."""
    example = (ROOT / "examples" / "position.py").read_text()
    assert example in [block.text for block in BLOCKS if block.page.name == "README.md"]


def test_readme_is_short() -> None:
    """The README has at most 180 lines."""
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 185
    assert {"run", "test"} <= set(re.findall(r"\bmake (\w+)", text))


@pytest.mark.slow
def test_speed_in_readme_matches_last_measurement() -> None:
    """The throughput figures in the README equal those in performance.json."""
    measured = json.loads((DOCS / "explanation" / "performance.json").read_text())
    full = measured["results"][measured["flight"]]["full"]
    rows = re.search(
        r"<!-- speed -->\n(.*?)<!-- /speed -->", (ROOT / "README.md").read_text(), re.DOTALL
    )
    assert rows is not None
    shown = re.findall(r"^\| \w.*? \| ([\d,]+) ", rows[1], re.MULTILINE)
    assert shown == [f"{full[form]['rate']:,.0f}" for form in SHOWN]


def test_mentioned_compose_files_and_variables_exist() -> None:
    """Every compose command names existing files and profiles, and every variable is used in a compose file."""
    stacks = {file.name: file.read_text() for file in ROOT.glob("docker-compose*.yml")}
    shown = [
        each for block in SHELLS for each in block.commands if each.startswith("docker compose ")
    ]
    assert len(shown) > 6
    for command in shown:
        files = re.findall(r"-f (\S+)", command)
        assert set(files) <= set(stacks)
        for profile in re.findall(r"--profile (\S+)", command):
            assert f"profiles: [{profile}]" in stacks["docker-compose.yml"]
    for variable in re.findall(
        r"`(NEDBUS_[A-Z]+_IMAGE|NEDBUS_PUBLISH|NEDBUS_PKI|NEDBUS_USER|NEDBUS_WEB)`", ALL
    ):
        assert any(variable in text for text in stacks.values())


def test_every_finding_is_listed() -> None:
    """findings/README.md and the page of differences name each script of findings/, and no other."""
    scripts = sorted(script.stem for script in (ROOT / "findings").glob("*.sh"))
    listed = re.findall(
        r"^\| `([\w-]+)` \|", (ROOT / "findings" / "README.md").read_text(), re.MULTILINE
    )
    assert listed == scripts
    assert sorted({row.script for row in differences()}) == scripts


@dataclass(frozen=True)
class Difference:
    """A row of the page of differences: the packages that show it, with versions, and the script."""

    packages: str
    script: str


def differences() -> list[Difference]:
    """Return the rows of the page of differences, each of which has five columns and ends with a script."""
    page = (DOCS / "beside-other-tools.md").read_text()
    head, _, *rows = re.findall(r"^\|.*\|$", page.partition("## Differences")[2], re.MULTILINE)
    columns = head.count(" | ") + 1
    found = []
    for row in rows:
        cells = row.strip("| ").split(" | ")
        assert len(cells) == columns, row
        source = re.fullmatch(r"(.+), `([\w-]+)`", cells[-1])
        assert source, f"no script at the end of: {row}"
        found.append(Difference(*source.groups()))
    return found


def test_every_difference_has_a_script_that_installs_its_versions() -> None:
    """Each row of the page of differences names an existing script, which installs the versions that the row names."""
    rows = differences()
    assert len(rows) > 50
    for row in rows:
        script = ROOT / "findings" / f"{row.script}.sh"
        assert script.is_file(), row
        text = script.read_text()
        for version in re.findall(r"(?<![\w.-])\d+(?:\.\d+)*(?![\w.-])", row.packages):
            assert version in text, f"{row.script} does not install {version}"


def test_relative_links_resolve() -> None:
    """The target file and heading of every relative link exist; the site has no page from outside docs."""
    for page in (*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", ROOT / "SECURITY.md"):
        for target, anchor in re.findall(r"\]\((?!https?:)([^)#]*)#?([^)]*)\)", page.read_text()):
            file = page.parent / target if target else page
            assert file.exists(), f"{page.name}: {target}"
            on_site = DOCS in file.resolve().parents or DOCS not in page.parents
            assert on_site or file.suffix != ".md", f"{page.name}: the site does not have {target}"
            headings = re.findall(r"^#+ (.*)", file.read_text(), re.MULTILINE) if anchor else []
            anchors = [re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in headings]
            assert not anchor or anchor in anchors, f"{page.name}: {target}#{anchor}"


BARE_EXTRA = re.compile(r"(?<![\w./])nedbus\[[^\]\n]*\](?! @ )")
INSTALL = re.compile(r"\b(?:pip3?|pipx|uv)\b.*\b(?:install|download|run|add)\b(.*)")
BARE_NAME = re.compile(r"""(?<![^\s"'`])nedbus(?=[\s"'`=<>~!]|$)(?! @ )""")


def bare_names(text: str) -> list[str]:
    """Return the places where a text passes the bare name nedbus to an installer, without a path or URL."""
    commands = [(match[0], match[1].partition("&&")[0]) for match in INSTALL.finditer(text)]
    return BARE_EXTRA.findall(text) + [
        whole for whole, arguments in commands if BARE_NAME.search(arguments)
    ]


@pytest.mark.slow
def test_no_text_installs_nedbus_from_pypi() -> None:
    """The name on PyPI is not ours: every install command uses a path or a URL."""
    for refused in ('"nedbus[web]"', "-U nedbus", "nedbus==1"):
        assert bare_names(f"pip install {refused}"), refused
    assert bare_names("extra `nedbus[all]`")
    for allowed in ('".[web]"', "./nedbus-1.whl", "'nedbus[web] @ git+ssh://host/x'"):
        assert not bare_names(f"pip install {allowed}"), allowed
    folders = ("docs", "service", "schemas", "examples", "packaging", "config")
    files = [file for folder in folders for file in (ROOT / folder).rglob("*") if file.is_file()]
    files += [*ROOT.glob("*.md"), *ROOT.glob("*.yml"), ROOT / "Dockerfile", ROOT / "Makefile"]
    texts = {file: file.read_text() for file in files if file.suffix not in (".png", ".pyc")}
    assert {str(file): names for file, text in texts.items() if (names := bare_names(text))} == {}


def test_reference_has_every_public_name() -> None:
    """The reference has an entry with a description for each public name, and for the methods of the bus."""
    page = api_page()
    entries = dict(
        re.findall(r"^### `([\w.]+)`\n\n(.*?)(?=\n\n###? |\Z)", page, re.MULTILINE | re.DOTALL)
    )
    constants = dict(
        re.findall(
            r"^\| `([\w.]+)` \| .*? \| (.+) \|$", page.partition("## Constants")[2], re.MULTILINE
        )
    )
    modules = {name.removeprefix("nedbus."): import_module(name) for name in PUBLIC_MODULES[1:]}
    others = {
        f"{short}.{name}"
        for short, module in modules.items()
        for name in {*module.__all__} - {*nedbus.__all__}
    }
    assert {*entries, *constants} == {*nedbus.__all__, *others}
    assert all(re.search(r"[a-z]{3}.*\.", text) for text in entries.values())
    assert all(constants.values())
    for name in ("subscribe", "latest", "vehicles", "publisher", "services"):
        assert f"{name}(" in entries["Bus"]


def test_reference_has_every_option() -> None:
    """Each command has a section with all of its options and arguments."""
    page = commands_page()
    sections = dict(
        re.findall(r"^## `(nedbus[^`]*)`\n(.*?)(?=\n## |\Z)", page, re.MULTILINE | re.DOTALL)
    )
    assert len(sections) > 25
    for name, command in commands():
        for option in command.params:
            assert all(each in sections[name] for each in option.opts if each.startswith("-")), (
                f"{name} {option.opts}"
            )


def test_reference_has_every_setting() -> None:
    """The reference lists each setting with variable and flag, and each kind of source with its options."""
    page = settings_page()
    for name in Settings.model_fields:
        assert f"| `{name}` | `NEDBUS_{name.upper()}` | `--{name.replace('_', '-')}` |" in page
    for name, kind in SOURCE_KINDS.items():
        section = page.partition(f"### `{name}:")[2].partition("###")[0]
        assert all(f"| `{option}` |" in section for option in kind.options.model_fields)


def test_reference_lists_events_topics_messages_and_limits() -> None:
    """The reference lists the events of logs and vehicles, topics, messages, and limits such as the size of a queue."""
    events, keys, limits = events_page(), keys_page(), limits_page()
    assert all(f"| `{name}` | " in events for name in (*EVENTS, *KINDS))
    assert all(f"| `{name}` | " in keys for name in (*TOPICS, *MESSAGES))
    assert "| `65,536` |" in limits


def test_reference_has_every_metric() -> None:
    """The reference lists each metric, including those of the alert rules, with its labels."""
    page = metrics_page()
    assert all(f"| `{name}" in page for name in METRICS)
    alerts = (ROOT / "packaging" / "prometheus" / "alerts.yml").read_text()
    assert all(
        f"| `{name}" in page
        for name in re.findall(r"\b(nedbus_[a-z_]+?)(?:_bucket|_sum|_count)?\b[{\[ )]", alerts)
    )
    assert "| `nedbus_stream_age_seconds` | gauge | `vehicle, topic, source` |" in page


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "pip install" in TEXTS[page]], ids=lambda page: page.stem
)
def test_install_line_of_a_page_covers_its_commands_and_snippets(page: Path) -> None:
    """A page that installs extras or packages installs all that its commands, imports and data frames need."""
    assert needed_packages(page) - installed_packages(page) == set()


def test_needs_of_a_page_are_found(tmp_path: Path) -> None:
    """Sources, suffixes, commands, imports, data frames and calls determine what a page needs."""
    page = ROOT / "docs" / "recordings.md"
    assert needed_packages(page) >= {"mcap", "plot", "foxglove", "pandas", "pyarrow"}
    other = tmp_path / "needs.md"
    other.write_text(
        "```bash\nnedbus serve --source mavlink:udpin:0.0.0.0:14540\nnedbus web a.mcap\n```\n"
        '```python\nimport scipy\n```\n`pip install -e ".[web,mcap]" scipy`\n'
    )
    assert needed_packages(other) == {"mavlink", "web", "mcap", "scipy"}
    assert installed_packages(other) == {"-e", "web", "mcap", "scipy"}


def test_alerts_of_the_page_are_those_of_the_rules() -> None:
    """docs/operate.md lists the alerts with their severities and durations; a stale stream is that of nedbus.health."""
    rules = (ROOT / "packaging" / "prometheus" / "alerts.yml").read_text()
    page = TEXTS[ROOT / "docs" / "operate.md"]
    rows = re.findall(r"^\| `(Nedbus\w+)` \| (\w+) \| (.*) \|$", page, re.MULTILINE)
    alerts = rules.split("- alert: ")[1:]
    assert [row[0] for row in rows] == [text.split()[0] for text in alerts]
    for (name, severity, condition), text in zip(rows, alerts, strict=True):
        assert f"severity: {severity}\n" in text, name
        if waits := re.search(r"\bfor: (\d+)([sm])\n", text):
            assert f"{waits[1]} {'min' if waits[2] == 'm' else 's'}" in condition, name
    stale = re.search(
        r"age_seconds > (\d+) unless .*_age_seconds \* \w+usual_rate_hertz < (\d+)\n", rules
    )
    stream = StreamHealth("vehicle_local_position")
    for number in range(20):
        stream.add({"timestamp": number * 10_000_000}, received=number * 10_000_000_000)
    assert stale is not None
    assert float(stale[1]) == TIMINGS.stale
    assert float(stale[2]) == stream.stale_after / 10
    assert float(stale[2]) == 3
    assert "| no message for 3 s, or three usual intervals of a slower stream, plus 5 s |" in page


def test_fields_converted_from_heartbeat_are_those_of_the_page() -> None:
    """docs/live.md names fields of vehicle_status that HEARTBEAT provides, and those that it does not."""
    row = next(
        line
        for line in TEXTS[ROOT / "docs" / "live.md"].splitlines()
        if line.startswith("| `vehicle_status` | `HEAR")
    )
    named, _, others = row.partition("; the sensors of")
    absent = others.partition("; not ")[2]
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, 128, 0, 4, 3)
    heartbeat.pack(mavlink.MAVLink(None, 1, 1))
    provided = CONVERSIONS["HEARTBEAT"][1](heartbeat)
    assert {"arming_state", "system_type", "failsafe"} == set(re.findall(r"`([a-z_]+)`", named)) - {
        "vehicle_status"
    }
    assert provided.keys() >= {"arming_state", "system_type", "failsafe"}
    assert provided.keys().isdisjoint(re.findall(r"`([a-z_]+)`", absent))


def test_contributing_names_files_that_exist() -> None:
    """Each path in CONTRIBUTING exists, relative to the root, the service or the schemas."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    paths = re.findall(r"`((?:\w+/)+[\w.-]*)`", text)
    folders = ("service/nedbus", "service/nedbus/web", "service/nedbus/cli", "schemas")
    roots = [ROOT, *(ROOT / folder for folder in folders)]
    subpackages = {f"{name}/" for name in ("publishing", "receiving", "health")}
    assert len(paths) > 40
    known = {
        path
        for path in paths
        if path in subpackages or any((root / path).exists() for root in roots)
    }
    assert [path for path in paths if path not in known] == []


def test_guarantees_name_tests_that_exist() -> None:
    """Each test that proves a guarantee is defined in one of the files linked in the same row."""
    page = ROOT / "docs" / "explanation" / "guarantees.md"
    proofs = [line for line in page.read_text().splitlines() if line.startswith("| proof |")]
    assert len(proofs) >= 10
    for proof in proofs:
        code = "".join(
            (page.parent / file).read_text() for file in re.findall(r"\]\(([^)]+\.py)\)", proof)
        )
        names = re.findall(r"`(test_\w+|[A-Z]\w+Machine)`", proof)
        assert names, proof
        assert [name for name in names if not re.search(rf"(def|class) {name}\b", code)] == []


def test_logger_topics_fit_beside_the_default_profile() -> None:
    """PX4 subscribes to ten instances of a topic in a line without one; 255 subscriptions are its limit.

    With 16 lines without an instance and the default profile, a PX4 of 2026-08-21 rejected 68 of 339.
    """
    lines = [line.split() for line in (DOCS / "logger_topics.txt").read_text().splitlines()]
    assert {len(line) for line in lines} == {3}, "topic, interval, instance"
    requested = {(topic, int(instance)) for topic, _, instance in lines}
    profile = 255 + 68 - 10 * 16
    assert len(requested) == len(lines) < 255 - profile
    assert {"vehicle_local_position", "vehicle_attitude", "home_position"} < {
        topic for topic, _ in requested
    }
    several = {topic for topic, instance in requested if instance > 0}
    assert several == {"sensor_gps", "battery_status", "estimator_status_flags"}
    assert all(TOPICS[topic].instances for topic in several)
