"""A study with people: its pages and its figures. All answers here are constructed."""

import hashlib
import json
import math
import random
import re
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.faults import NO_TORCH, assert_fails, run_case
from tests.builders.programs.browser import Fingers, Opened, needs_chromium, open_browser
from warpir.core.errors import InputError
from warpir.core.strict_json import parse_json_object
from warpir.io.images.writers import png_bytes
from warpir.study.answers import AUTOMATED, BROWSER, check_sheet
from warpir.study.command import main
from warpir.study.images import neutral_png, read_image, upside_down
from warpir.study.key import Study, key_bytes, protocol_bytes, read_study
from warpir.study.pages import Images, page
from warpir.study.pairs import Words
from warpir.study.plan import Pair, Plan, balanced_sides, make_plan
from warpir.study.score import WARNING, fleiss_kappa, majority, proportion

HEIGHT, WIDTH = 40, 60
METHOD, BASELINE = "our-secret-method", "their-secret-baseline"
HOSTILE = "</script><img src=x onerror='alert(\"1\")'>"
SIZE = ("width", "height")


# -------------------------------------------------------------------------------- made inputs


def photo_of(seed: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return a picture without an object."""
    return np.random.default_rng(seed).integers(90, 160, (HEIGHT, WIDTH, 3), np.uint8)


def write_scene(folder: Path, seed: int, methods: Sequence[str] = (METHOD, BASELINE)) -> None:
    """Write a photo, and for each method the same with an object, marked as warpir marks its."""
    folder.mkdir(parents=True)
    photo = photo_of(seed)
    (folder / "photo.png").write_bytes(png_bytes(photo, None, False, ""))
    for k, name in enumerate(methods):
        image = photo.copy()
        image[10:20, 20:40] = (40 + 30 * k, 20, 10)
        image[20:26, 20:40] //= 2
        (folder / f"{name}.png").write_bytes(png_bytes(image, None, True, f"made by {name}"))


@pytest.fixture
def scenes(tmp_path: Path) -> Path:
    folder = tmp_path / "scenes"
    for k in range(2):
        write_scene(folder / f"scene-{k}", k)
    return folder


def make(scenes: Path, out: Path, *more: str) -> Study:
    """Make a study of one run by three people, if nothing else is said."""
    defaults = [] if "--runs" in more else ["--runs", "1", "--raters", "3"]
    argv = ["make", str(scenes), "--out", str(out), "--seed", "5", *defaults, *more]
    assert main([*argv, *([] if scenes.is_file() else ["--method", METHOD])]) == 0
    return read_study(out)


def sheet_of(
    plan: Plan,
    index: int,
    prefers_a: Callable[[int], bool] = lambda pair: True,
    source: str = AUTOMATED,
) -> dict[str, Any]:
    """Return what a rater's page would save; who is built here is nobody, hence `AUTOMATED`."""
    rater = plan.raters[index]
    answers = [
        {
            "trial": trial.id,
            "choice": trial.a_side if prefers_a(trial.pair) else 3 - trial.a_side,
            "ms": 1000 + 100 * k,
            "zoomed": k % 2 == 0,
        }
        for k, trial in enumerate(rater.trials)
    ]
    return {
        "format": 1,
        "study": plan.id,
        "rater": rater.token,
        "source": source,
        "resumed": 0,
        "answers": answers,
    }


def write_answers(folder: Path, sheets: Sequence[Mapping[str, Any]]) -> None:
    (folder / "answers").mkdir(exist_ok=True)
    for sheet in sheets:
        (folder / "answers" / f"{sheet['rater']}.json").write_text(json.dumps(sheet))


def score(folder: Path, *more: str) -> dict[str, Any]:
    figures = folder.parent / "figures.json"
    argv = ["score", str(folder), "--include-automated", "--overwrite", "--json", str(figures)]
    assert main([*argv, *more]) == 0
    return dict(json.loads(figures.read_text()))


# ------------------------------------------------------------------------------- the statistics


def test_kappa_of_fleiss_example() -> None:
    """14 raters, 10 subjects, 5 categories: 0.210, the example that is usually printed."""
    counts = [
        [0, 0, 0, 0, 14], [0, 2, 6, 4, 2], [0, 0, 3, 5, 6], [0, 3, 9, 2, 0], [2, 2, 8, 1, 1],
        [7, 7, 0, 0, 0], [3, 2, 6, 3, 0], [2, 5, 3, 2, 2], [6, 5, 2, 1, 0], [0, 2, 2, 3, 7],
    ]  # fmt: skip
    kappa = fleiss_kappa(counts)
    assert kappa is not None and f"{kappa:.3f}" == "0.210"


def test_kappa_at_its_ends() -> None:
    assert fleiss_kappa([[9, 0], [0, 9]]) == 1.0
    assert fleiss_kappa([[1, 1], [1, 1]]) == -1.0
    assert fleiss_kappa([[9, 0], [9, 0]]) is None, "nobody said anything else"
    assert fleiss_kappa([[1, 0], [0, 1]]) is None, "nobody can be compared"
    assert fleiss_kappa([[9, 0], [0, 9], [1, 0]]) == 1.0, "one rater alone agrees with nobody"


def test_intervals_are_those_of_the_closed_forms() -> None:
    """Clopper-Pearson at the ends is a power; in between as tabulated; Wilson is a quadratic."""
    z = 1.959963984540054
    for n in (1, 11, 48):
        none, every = proportion(0, n), proportion(n, n)
        assert none.clopper_pearson == pytest.approx((0.0, 1.0 - 0.025 ** (1 / n)), abs=1e-12)
        assert every.clopper_pearson == pytest.approx((0.025 ** (1 / n), 1.0), abs=1e-12)
    seven = proportion(7, 10)
    assert seven.clopper_pearson == pytest.approx((0.3475471, 0.9332605), abs=1e-6)
    centre = (0.7 + z * z / 20) / (1 + z * z / 10)
    half = z * math.sqrt(0.7 * 0.3 / 10 + z * z / 400) / (1 + z * z / 10)
    assert seven.wilson == pytest.approx((centre - half, centre + half), abs=1e-12)
    # One-sided, 9 of 11, 13 of 18 and 31 of 48 are the first below .05.
    for n, first in ((11, 9), (18, 13), (48, 31)):
        for count, is_below in ((first, True), (first - 1, False)):
            p_value = proportion(count, n).p_value
            assert p_value is not None and (p_value / 2 < 0.05) is is_below


def test_a_tie_counts_half_and_is_left_out_of_the_interval() -> None:
    found = majority([(2, 1), (1, 1), (0, 2), (3, 0)])
    assert (found.count, found.total, found.ties, found.share) == (2.5, 4, 1, 0.625)
    assert found.clopper_pearson == proportion(2, 3).clopper_pearson
    assert majority([]).share is None and majority([(1, 1)]).p_value is None


# ----------------------------------------------------------------------------------- the plan


def pairs_of(count: int, catches: int = 0) -> list[Pair]:
    ordinary = [Pair(f"s{k}", "", "b") for k in range(count)]
    return ordinary + [Pair(f"c{k}", "", "", "made worse") for k in range(catches)]


@pytest.mark.parametrize(("rows", "columns"), [(9, 48), (9, 11), (8, 7), (1, 5), (3, 1)])
def test_sides_are_even_and_random(rows: int, columns: int) -> None:
    table = np.array(balanced_sides(rows, columns, random.Random(3)))
    assert set(np.unique(table)) <= {1, 2}
    for axis, length in ((0, rows), (1, columns)):
        ones = (table == 1).sum(axis=axis)
        assert set(ones) <= {length // 2, (length + 1) // 2}
    if rows > 2 and columns > 10:
        # Not a chessboard any more, in which any two raters see the same or the opposite.
        alike = {int((table[0] == row).sum()) for row in table[1:]}
        assert not alike <= {0, columns}


def test_every_rater_sees_all_in_an_order_of_their_own() -> None:
    plan = make_plan(pairs_of(20, 2), raters=9, runs=3, seed=1)
    assert len(plan.raters) == 27 == len({rater.token for rater in plan.raters})
    assert Counter(rater.run for rater in plan.raters) == {1: 9, 2: 9, 3: 9}
    orders = set()
    for rater in plan.raters:
        kinds = Counter(trial.kind for trial in rater.trials)
        assert kinds == {"pair": 20, "repeat": 2, "catch": 2}
        assert {t.pair for t in rater.trials if t.kind == "pair"} == set(range(20))
        orders.add(tuple(t.pair for t in rater.trials))
        for place, trial in enumerate(rater.trials):
            if trial.kind == "repeat":
                first = next(k for k, t in enumerate(rater.trials) if t.pair == trial.pair)
                assert rater.trials[first].kind == "pair"
                assert trial.a_side == 3 - rater.trials[first].a_side
                assert place - first > 10
    assert len(orders) == 27
    ids = [trial.id for rater in plan.raters for trial in rater.trials]
    assert len(ids) == len(set(ids))


def test_a_pair_is_first_and_last_for_some() -> None:
    plan = make_plan(pairs_of(5), raters=90, runs=1, seed=2, repeats=0)
    for place in (0, -1):
        assert len({rater.trials[place].pair for rater in plan.raters}) == 5


def test_many_pairs_are_shared_out() -> None:
    plan = make_plan(pairs_of(10, 1), raters=3, runs=2, seed=1, pairs_per_rater=4, repeats=0)
    assert len(plan.raters) == 3 * 3 * 2
    assert max(sum(t.kind == "pair" for t in r.trials) for r in plan.raters) == 4
    for run in (1, 2):
        seen = Counter(
            t.pair for r in plan.raters if r.run == run for t in r.trials if t.kind == "pair"
        )
        assert seen == dict.fromkeys(range(10), 3)
    assert all(any(t.kind == "catch" for t in r.trials) for r in plan.raters)


# ------------------------------------------------------------------------- published figures

# Votes that give the figures the authors print. They are constructed here, not the authors': no
# other counts of 11, 48 or 18 scenes in three runs round to these means and deviations (but in the
# two cells of two choices), and which scene got how many is made up.
POLY_HAVEN = {
    "Wang 2021": ((7, 10, 11), (64, 66, 67), "84.8 +- 18.9", "66.3 +- 1.5"),
    "StyleLight": ((8, 8, 9), (57, 57, 66), "75.8 +- 5.2", "60.6 +- 5.2"),
    "DiffusionLight": ((7, 7, 8), (56, 57, 57), "66.7 +- 5.2", "57.2 +- 0.6"),
}
WAYMO_GROUPS = {"sunny": 17, "cloudy": 15, "twilight": 9, "night": 7}
WAYMO = {
    "Hold-Geoffroy 2019": (
        ((9, 11, 11), (8, 10, 12), (8, 8, 4), (7, 4, 7)),
        ("60.8 +- 6.8", "66.7 +- 13.3", "74.1 +- 25.7", "85.7 +- 24.7", "68.8 +- 2.1"),
    ),
    "NLFE": (
        ((13, 13, 15), (9, 12, 12), (4, 3, 5), (5, 4, 2)),
        ("80.4 +- 6.8", "73.3 +- 11.5", "44.4 +- 11.1", "52.4 +- 21.8", "67.4 +- 3.2"),
    ),
    "StyleLight": (
        ((10, 14, 15), (12, 14, 15), (4, 6, 8), (5, 4, 5)),
        ("76.5 +- 15.6", "91.1 +- 10.2", "66.7 +- 22.2", "66.7 +- 8.2", "77.8 +- 12.6"),
    ),
    "DiffusionLight": (
        ((12, 13, 16), (13, 11, 7), (4, 6, 5), (4, 6, 5)),
        ("80.4 +- 12.2", "68.9 +- 20.4", "55.6 +- 11.1", "71.4 +- 14.3", "70.8 +- 3.6"),
    ),
}


def votes_with(preferred: int, scenes: int, total: int | None = None) -> list[int]:
    """Return votes of 9 for each scene, most of them for the method in just so many scenes."""
    votes = [6] * preferred + [3] * (scenes - preferred)
    missing = 0 if total is None else total - sum(votes)
    for k in range(scenes):
        low, high = (5, 9) if k < preferred else (0, 4)
        step = min(max(missing, low - votes[k]), high - votes[k])
        votes[k] += step
        missing -= step
    assert missing == 0
    return votes


def write_study(folder: Path, plan: Plan, raters: int, runs: int) -> None:
    """Write a study without pages."""
    study = Study(plan, "DiPIR", raters, runs, 0, "constructed")
    folder.mkdir()
    protocol = protocol_bytes(study, Words())
    (folder / "study.json").write_bytes(protocol)
    (folder / "key.json").write_bytes(key_bytes(study, protocol, [{} for _ in plan.pairs]))


def constructed_study(
    folder: Path, pairs: Sequence[Pair], votes: Sequence[Mapping[int, int]]
) -> None:
    """Write a study and answers that hold these votes of 9, by run and pair."""
    plan = make_plan(pairs, raters=9, runs=len(votes), seed=1)
    write_study(folder, plan, 9, len(votes))
    sheets = []
    for index, rater in enumerate(plan.raters):
        of_run, turn = votes[rater.run - 1], index % 9
        sheets.append(
            sheet_of(plan, index, lambda k, v=of_run, t=turn: (t + k) % 9 < v[k])  # type: ignore[misc]
        )
    write_answers(folder, sheets)


def test_published_poly_haven_table_comes_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Main paper, table 2: 11 scenes, three baselines, images preferred and single votes."""
    pairs = [Pair(f"s{k}", "", name) for name in POLY_HAVEN for k in range(11)]
    votes: list[dict[int, int]] = [{}, {}, {}]
    for b, (images, singles, _, _) in enumerate(POLY_HAVEN.values()):
        for run in range(3):
            found = votes_with(images[run], 11, singles[run])
            votes[run] |= {11 * b + k: vote for k, vote in enumerate(found)}
    constructed_study(tmp_path / "study", pairs, votes)
    report = score(tmp_path / "study", "--markdown", str(tmp_path / "table.md"))
    assert capsys.readouterr().out.splitlines()[0] == WARNING
    assert next(iter(report.values())) == WARNING
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert WARNING in lines[0]
    for name, (_, _, images_printed, votes_printed) in POLY_HAVEN.items():
        assert any(f"| {name} | 11 | {images_printed} | {votes_printed} |" in x for x in lines)


@pytest.mark.slow
def test_published_waymo_table_comes_out(tmp_path: Path) -> None:
    """Main paper's Waymo table: four baselines, 48 scenes in four groups and together."""
    groups = [name for name, count in WAYMO_GROUPS.items() for _ in range(count)]
    pairs = [Pair(f"s{k}", group, name) for name in WAYMO for k, group in enumerate(groups)]
    votes: list[dict[int, int]] = [{}, {}, {}]
    for b, (images, _) in enumerate(WAYMO.values()):
        for run in range(3):
            found = [
                vote
                for of_group, count in zip(images, WAYMO_GROUPS.values(), strict=True)
                for vote in votes_with(of_group[run], count)
            ]
            votes[run] |= {48 * b + k: vote for k, vote in enumerate(found)}
    constructed_study(tmp_path / "study", pairs, votes)
    score(tmp_path / "study", "--markdown", str(tmp_path / "table.md"))
    text = (tmp_path / "table.md").read_text()
    for name, (_, printed) in WAYMO.items():
        rows = [*((f"{name}, {g}", n) for g, n in WAYMO_GROUPS.items()), (name, 48)]
        for (row, count), cell in zip(rows, printed, strict=True):
            assert f"| {row} | {count} | {cell} |" in text


def test_published_ablation_comes_out_and_is_no_evidence(tmp_path: Path) -> None:
    """64.8 +- 14.0 of 18 scenes; over scenes that is not distinguishable from chance."""
    pairs = [Pair(f"s{k}", "", "without") for k in range(18)]
    votes = [dict(enumerate(votes_with(images, 18))) for images in (9, 12, 14)]
    constructed_study(tmp_path / "study", pairs, votes)
    comparison = score(tmp_path / "study")["kept"]["comparisons"][0]
    spread = comparison["images_preferred"]
    assert f"{100 * spread['mean']:.1f} +- {100 * spread['sd']:.1f}" == "64.8 +- 14.0"
    assert [run["images"]["count"] for run in comparison["runs"]] == [9, 12, 14]
    assert comparison["runs"][1]["images"]["p_value"] == pytest.approx(0.2379, abs=1e-4)


# -------------------------------------------------------------------------------- the figures


def test_who_misses_a_catch_pair_is_excluded_and_shown(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study = make(scenes, tmp_path / "study")
    plan = study.plan
    catch = next(k for k, pair in enumerate(plan.pairs) if pair.is_catch)
    careless = sheet_of(plan, 2, lambda pair: False)
    write_answers(tmp_path / "study", [sheet_of(plan, 0), sheet_of(plan, 1), careless])
    report = score(tmp_path / "study")
    assert report["sheets"]["excluded"] == [careless["rater"]]
    assert "more than 0" in report["exclusion"]
    kept, everybody = report["kept"], report["everybody"]
    assert (kept["raters"], everybody["raters"]) == (2, 3)
    assert kept["comparisons"][0]["votes_preferred"]["mean"] == 1.0
    assert everybody["comparisons"][0]["votes_preferred"]["mean"] == pytest.approx(2 / 3)
    assert everybody["catches_right"]["count"] == 2
    out = capsys.readouterr().out
    assert "2 raters, without the 1 excluded" in out
    assert "all 3 raters, with the 1 excluded" in out
    assert "nobody can be excluded" not in out
    # As many may be missed as was said before; of all that there are, a notice says so.
    study = make(scenes, tmp_path / "lenient", "--catch-misses", "1")
    assert "allows every catch pair, so nobody can be excluded" in capsys.readouterr().out
    lenient = [sheet_of(study.plan, k, lambda pair: pair != catch) for k in range(3)]
    write_answers(tmp_path / "lenient", lenient)
    assert score(tmp_path / "lenient")["sheets"]["excluded"] == []


def test_consistency_side_and_seconds(tmp_path: Path) -> None:
    """Who always presses 1 is never consistent; who always prefers the method always is."""
    pairs = pairs_of(10)
    constructed_study(tmp_path / "study", pairs, [dict.fromkeys(range(10), 9)])
    plan = read_study(tmp_path / "study").plan
    report = score(tmp_path / "study")["kept"]
    assert report["repeats_consistent"]["count"] == report["repeats_consistent"]["total"] == 9
    assert report["kappa"] is None
    assert abs(report["side_1_chosen"]["share"] - 0.5) < 0.06
    assert report["catches_right"]["share"] is None
    presses = [sheet_of(plan, k) for k in range(9)]
    for sheet in presses:
        for k, answer in enumerate(sheet["answers"]):
            answer["choice"] = 1
            answer["ms"] = 500 if k else 9000
    write_answers(tmp_path / "study", presses)
    report = score(tmp_path / "study")["kept"]
    assert report["repeats_consistent"]["count"] == 0
    assert report["side_1_chosen"]["share"] == 1.0
    assert report["side_1_chosen"]["p_value"] == pytest.approx(2 * 0.5**90)
    assert report["median_seconds"] == 0.5


def test_missing_raters_are_told(scenes: Path, tmp_path: Path) -> None:
    study = make(scenes, tmp_path / "study", "--pairs-per-rater", "1")
    write_answers(tmp_path / "study", [sheet_of(study.plan, 0)])
    report = score(tmp_path / "study")
    assert (report["sheets"]["found"], report["sheets"]["expected"]) == (1, 6)
    comparison = report["kept"]["comparisons"][0]
    assert (comparison["scenes"], comparison["scenes_without_votes"]) == (2, 1)
    assert comparison["images_preferred"] == {"mean": 1.0, "sd": None}


def test_scenes_without_votes_are_told_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By their row: of each group, or of all scenes where there are no groups."""
    groups = ("sunny", "sunny", "night", "")
    pairs = [Pair(f"s{k}", group, "grouped") for k, group in enumerate(groups)]
    pairs += [Pair("s0", "", "plain"), Pair("s1", "", "plain")]
    plan = make_plan(pairs, raters=1, runs=1, seed=1, pairs_per_rater=1)
    write_study(tmp_path / "study", plan, 1, 1)
    seen = next(k for k, rater in enumerate(plan.raters) if rater.trials[0].pair == 0)
    write_answers(tmp_path / "study", [sheet_of(plan, seen)])
    score(tmp_path / "study", "--markdown", str(tmp_path / "table.md"))
    told = [
        "no votes yet: 1 scenes against grouped, sunny",
        "no votes yet: 1 scenes against grouped, night",
        "no votes yet: 1 scenes against grouped, no group",
        "no votes yet: 2 scenes against plain",
    ]
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line.startswith("no votes")] == told
    assert (tmp_path / "table.md").read_text().count("no votes") == len(told)


def test_hostile_names_stay_text(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In Markdown, HTML, rich's markup and the lines of a terminal."""
    name = "[bold]a|b`<b>\x1b[31m\n# c"
    pairs = [Pair("s", "", name), Pair("t", name, "plain")]
    constructed_study(tmp_path / "study", pairs, [{0: 9, 1: 9}])
    score(tmp_path / "study", "--markdown", str(tmp_path / "table.md"))
    out, text = capsys.readouterr().out, (tmp_path / "table.md").read_text()
    assert "\x1b[31m" not in out + text
    assert "[bold]a" in out.replace("\n", "")
    assert "\n# c" not in text and "<b>" not in text
    row = next(line for line in text.splitlines() if "bold" in line)
    assert r"\[bold\]a\|b\`&lt;b>" in row
    assert len(re.findall(r"(?<!\\)\|", row)) == 10


# ---------------------------------------------------------------------------------- the pages


def test_nothing_tells_the_methods_apart(scenes: Path, tmp_path: Path) -> None:
    """Neither names nor contents of what may be published, the images' own text included."""
    study = make(scenes, tmp_path / "study")
    pages = sorted((tmp_path / "study" / "pages").iterdir())
    assert len(pages) == 3 + 3 * 3
    for path in pages:
        content = path.name.encode() + path.read_bytes()
        for secret in (METHOD, BASELINE, "scene-", "made by", "ompositeSynthetic"):
            assert secret.encode() not in content, (path, secret)
        for sheet in re.findall(rb'id="sheet">(.*?)</script>', content, re.DOTALL):
            assert set(json.loads(sheet)["trials"][0]) == {"id", "images", "photo", *SIZE}
        assert re.fullmatch(r"[0-9a-f]{20}\.(png|html)", path.name)
    key = json.loads((tmp_path / "study" / "key.json").read_text())
    files = [image["file"] for pair in key["pairs"] for image in pair["images"].values()]
    assert len(files) == len(set(files)), "an image that came back would be the method's"
    # The pictures are those that were given, to the code.
    for pair, sources in zip(study.plan.pairs, key["pairs"], strict=True):
        if not pair.is_catch:
            for part, name in (("a", METHOD), ("b", pair.baseline), ("photo", "photo")):
                shown = read_image(tmp_path / "study/pages" / sources["images"][part]["file"])
                assert (shown == read_image(scenes / pair.scene / f"{name}.png")).all()


def test_pages_show_the_side_that_the_key_says(scenes: Path, tmp_path: Path) -> None:
    study = make(scenes, tmp_path / "study")
    key = json.loads((tmp_path / "study" / "key.json").read_text())
    for rater in study.plan.raters:
        text = (tmp_path / "study/pages" / f"{rater.token}.html").read_text()
        found = re.search(r'id="sheet">(.*?)</script>', text, re.DOTALL)
        assert found is not None
        shown = json.loads(found.group(1))["trials"]
        for trial, entry in zip(rater.trials, shown, strict=True):
            images = key["pairs"][trial.pair]["images"]
            assert entry["images"][trial.a_side - 1] == images["a"]["file"]
            assert entry["images"][2 - trial.a_side] == images["b"]["file"]
            assert (entry["id"], entry["width"]) == (trial.id, WIDTH)


def test_a_seed_makes_the_same_study_and_none_another(scenes: Path, tmp_path: Path) -> None:
    def content(name: str) -> dict[str, bytes]:
        root = tmp_path / name
        return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}

    make(scenes, tmp_path / "a")
    make(scenes, tmp_path / "b")
    assert content("a") == content("b")
    for name in ("c", "d"):
        argv = ["make", str(scenes), "--method", METHOD, "--out", str(tmp_path / name)]
        assert main([*argv, "--raters", "1", "--runs", "1"]) == 0
    assert not set(content("c")) & set(content("d")) - {"key.json", "study.json"}


def test_texts_of_a_manifest_are_escaped() -> None:
    pairs = [Pair(HOSTILE, HOSTILE, HOSTILE)]
    plan = make_plan(pairs, raters=1, runs=1, seed=1)
    words = Words(HOSTILE, HOSTILE + "{title}", HOSTILE, HOSTILE)
    text = page(plan, plan.raters[0], [Images("a.png", "b.png", None, 3, 2)], words).decode()
    assert "<img src=x" not in text and "{title}" in text
    assert text.count("</script>") == 2


def test_neutral_images_hold_nothing_but_pixels() -> None:
    content, names = neutral_png(photo_of(1)), []
    place = 8
    while place < len(content):
        names.append(content[place + 4 : place + 8])
        place += 12 + int.from_bytes(content[place : place + 4])
    assert names == [b"IHDR", b"sRGB", b"IDAT", b"IEND"]


def test_made_catch_pairs_hang_upside_down() -> None:
    photo = photo_of(3)
    image = photo.copy()
    image[10:14, 5:9] = 255
    image[14:20, 5:9] = 0
    turned = upside_down(image, photo)
    assert turned is not None
    assert (turned[10:16, 5:9] == 0).all() and (turned[16:20, 5:9] == 255).all()
    untouched = np.ones((HEIGHT, WIDTH), bool)
    untouched[10:20, 5:9] = False
    assert (turned[untouched] == photo[untouched]).all()
    assert upside_down(photo, photo) is None
    assert upside_down(np.full_like(photo, 255), photo) is None


def test_given_catch_pairs_and_words(scenes: Path, tmp_path: Path) -> None:
    """A manifest's own catch pairs are used, and none are made."""
    manifest = scenes / "pairs.json"
    content = manifest_of() | {
        "catches": [
            {
                "scene": "scene-1",
                "better": "scene-1/photo.png",
                "worse": f"scene-1/{BASELINE}.png",
                "how": "the object pasted without a shadow",
            }
        ],
        "question": "Which?",
    }
    manifest.write_text(json.dumps(content))
    study = make(manifest, tmp_path / "study")
    assert [p.how for p in study.plan.pairs] == ["", "the object pasted without a shadow"]
    assert study.plan.pairs[0].group == "sunny"
    protocol = json.loads((tmp_path / "study" / "study.json").read_text())
    assert (protocol["question"], protocol["catch_pairs"]) == ("Which?", 1)
    text = (tmp_path / "study" / protocol["pages"][0]).read_text()
    assert ">Which?</h1>" in text and "pasted without" not in text


def manifest_of() -> dict[str, Any]:
    images = {METHOD: f"scene-0/{METHOD}.png", BASELINE: f"scene-0/{BASELINE}.png"}
    scene = {"group": "sunny", "photo": "scene-0/photo.png", "images": images}
    return {"method": METHOD, "scenes": {"scene-0": scene}}


# ------------------------------------------------------------------------------- the refusals


AS_STUDY: dict[str, str] = {"program": "warpir.study.command", "before": NO_TORCH}
"""For `run_case` and `assert_fails`: neither torch nor Warp is looked at."""


def refuse(argv: Sequence[str], code: int, *words: str, cwd: Path) -> list[str]:
    """Check a refusal."""
    return assert_fails(argv, code, *words, cwd=cwd, **AS_STUDY)


MAKE = ("make", "scenes", "--method", METHOD, "--out", "study")


def set_scene(content: dict[str, Any], **changes: Any) -> dict[str, Any]:
    content["scenes"]["scene-0"] |= changes
    return content


BAD_MANIFESTS: dict[str, tuple[Callable[[dict[str, Any]], Any], tuple[str, ...]]] = {
    "list": (lambda m: [m], ("not a JSON object",)),
    "no method": (lambda m: m.pop("method") and m, ("method is missing",)),
    "unknown key": (lambda m: m | {"metod": "x"}, ("unknown key 'metod'",)),
    "scenes": (lambda m: m | {"scenes": []}, ("/scenes", "an object expected")),
    "no pairs": (lambda m: m | {"scenes": {}}, ("no pairs",)),
    "no method's image": (lambda m: m | {"method": "other"}, ("no image of the method 'other'",)),
    "one image": (lambda m: set_scene(m, images={METHOD: "scene-0/photo.png"}), ("no pairs",)),
    "missing image": (lambda m: set_scene(m, photo="gone.png"), ("gone.png", "no such file")),
    "long file name": (lambda m: set_scene(m, photo="x" * 300), ("xxx", "no such file")),
    "NUL": (lambda m: set_scene(m, photo="x\0.png"), ("no such file",)),
    "number": (lambda m: set_scene(m, group=3), ("/scenes/scene-0/group", "text of 1 to 100")),
    "group all": (lambda m: set_scene(m, group="all"), ("/scenes/scene-0/group", "'all'")),
    "no group": (lambda m: set_scene(m, group="no group"), ("'no group' is a row's own name",)),
    "empty text": (lambda m: m | {"question": " "}, ("/question",)),
    "long text": (lambda m: m | {"contact": "x" * 4001}, ("/contact", "1 to 4000")),
    "catches": (lambda m: m | {"catches": {}}, ("/catches", "a list expected")),
    "dishonest catch": (
        lambda m: m | {"catches": [{"scene": "s", "better": "a", "worse": "b"}]},
        ("/catches/0", "how is missing"),
    ),
}


@pytest.mark.parametrize("name", BAD_MANIFESTS)
def test_bad_manifests_are_refused(name: str, scenes: Path, tmp_path: Path) -> None:
    change, words = BAD_MANIFESTS[name]
    (scenes / "m.json").write_text(json.dumps(change(manifest_of())))
    refuse(["make", "scenes/m.json", "--out", "study"], 3, *words, cwd=tmp_path)


def test_help_is_of_the_study(capsys: pytest.CaptureFixture[str]) -> None:
    """Also of flags that an insertion has too."""
    assert main(["make", "--help"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "--seed N of sides and order (default: a new random one)" in text
    assert "--out STUDY new folder" in text and "--alpha" in text and "--max-pixels N" in text


def test_make_refuses_flags(scenes: Path, tmp_path: Path) -> None:
    (scenes / "m.json").write_text(json.dumps(manifest_of()))
    for argv, words in (
        (["make", "scenes", "--out", "study"], ("--method", "needed")),
        (["make", "scenes/m.json", "--method", "x", "--out", "s"], ("--method",)),
        ([*MAKE, "--raters", "0"], ("--raters", "from 1")),
        ([*MAKE, "--runs", "1_0"], ("--runs", "1_0")),
        ([*MAKE, "--seed", "-1"], ("--seed",)),
        ([*MAKE, "--catches", "3"], ("--catches", "3 cannot be made of 2")),
        ([*MAKE, "--colour"], ("--colour",)),
        ([*MAKE[:-1], "."], ("--out", "names no new folder")),
        ([*MAKE, "--runs", "9" * 5000], ("--runs", "from 1")),
        (["make", "scenes", "--out", "s", "--seed", "9" * 5000], ("--seed", "whole number")),
        ([], ("command line",)),
    ):
        refuse(argv, 2, *words, cwd=tmp_path)


def test_make_refuses_images(scenes: Path, tmp_path: Path) -> None:
    place = scenes / "scene-1"
    other = place / f"{BASELINE}.png"
    whole = other.read_bytes()
    other.write_bytes(png_bytes(photo_of(1)[:-1], None, False, ""))
    refuse(MAKE, 3, f"{BASELINE}.png", "size 60 x 39", "expected 60 x 40", cwd=tmp_path)
    other.write_bytes(whole[:100])
    refuse(MAKE, 3, f"{BASELINE}.png", cwd=tmp_path)
    other.write_bytes(whole)
    refuse([*MAKE, "--max-pixels", "100"], 3, "--max-pixels", cwd=tmp_path)
    photo = place / "photo.png"
    shutil.copy(place / f"{METHOD}.png", photo)
    shutil.copy(photo, other)
    shutil.rmtree(scenes / "scene-0")
    refuse(MAKE, 3, "no catch pair can be made", cwd=tmp_path)
    shutil.copy(photo, place / "photo.jpg")
    refuse(MAKE, 3, "two images are called 'photo'", cwd=tmp_path)


def test_a_study_is_never_written_over(scenes: Path, tmp_path: Path) -> None:
    make(scenes, tmp_path / "study")
    refuse(MAKE, 7, "study", "not an empty folder", cwd=tmp_path)
    (tmp_path / "file").write_text("")
    refuse([*MAKE[:-1], "file"], 7, "file", cwd=tmp_path)
    refuse([*MAKE[:-1], "x" * 300], 5, "xxx", "too long", cwd=tmp_path)


def test_make_needs_neither_torch_nor_warp(scenes: Path, tmp_path: Path) -> None:
    ended = run_case(MAKE, tmp_path, **AS_STUDY)
    assert ended.status == 0, ended
    assert "2 pairs against 1 baselines, 1 catch pairs" in ended.out
    assert not list(tmp_path.glob(".partial*"))


BAD_SHEETS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "unknown study": (lambda s: s | {"study": "x"}, "answers of another study"),
    "unknown rater": (lambda s: s | {"rater": "x"}, "no rater of this study"),
    "extra key": (lambda s: s | {"name": "Ann"}, "unknown keys: 'name'"),
    "format": (lambda s: s | {"format": 2}, "another format"),
    "source": (lambda s: s | {"source": "me"}, "/source"),
    "resumed": (lambda s: s | {"resumed": -1}, "/resumed"),
    "incomplete": (lambda s: s | {"answers": s["answers"][:-1]}, "not complete"),
    "order": (lambda s: s | {"answers": s["answers"][::-1]}, "/answers/0/trial"),
    "choice": (lambda s: answer_with(s, choice=3), "/answers/0/choice"),
    "true is not 1": (lambda s: answer_with(s, choice=True), "/answers/0/choice"),
    "time": (lambda s: answer_with(s, ms=-1), "/answers/0/ms"),
    "long time": (lambda s: answer_with(s, ms=10**12), "/answers/0/ms"),
    "zoomed": (lambda s: answer_with(s, zoomed=1), "/answers/0/zoomed"),
    "more": (lambda s: answer_with(s, note="x"), "/answers/0"),
}


def answer_with(sheet: dict[str, Any], **changes: Any) -> dict[str, Any]:
    sheet["answers"][0] |= changes
    return sheet


def test_score_refuses_bad_answers_and_lists_them(scenes: Path, tmp_path: Path) -> None:
    study = make(scenes, tmp_path / "study")
    folder = tmp_path / "study" / "answers"
    folder.mkdir()
    for change, words in BAD_SHEETS.values():
        bad = json.dumps(change(sheet_of(study.plan, 0, source=BROWSER)))
        with pytest.raises(InputError, match=f"^one.json: .*{words}"):
            check_sheet("one.json", parse_json_object("one.json", bad.encode()), study.plan)
    (folder / "one.json").write_text(json.dumps(sheet_of(study.plan, 0)))
    refuse(["score", "study"], 3, "one.json", "answered by a program", cwd=tmp_path)
    (folder / "one.json").write_text('{"format": NaN}')
    refuse(["score", "study"], 3, "one.json", "NaN", cwd=tmp_path)
    same = json.dumps(sheet_of(study.plan, 0, source=BROWSER))
    for name in ("one", "two"):
        (folder / f"{name}.json").write_text(same)
    (folder / "zero.json").write_text("[]")
    lines = refuse(["score", "study"], 3, "two.json", "the same rater as", cwd=tmp_path)
    assert lines[1].startswith("also: ") and "zero.json" in lines[1]


@pytest.mark.case("N20")
def test_score_refuses_the_rest(scenes: Path, tmp_path: Path) -> None:
    study = make(scenes, tmp_path / "study")
    refuse(["score", "study"], 3, "no answers", cwd=tmp_path)
    refuse(["score", "scenes"], 3, "no study", cwd=tmp_path)
    refuse(["score", "x" * 300], 3, "no study", cwd=tmp_path)
    refuse(["make", "x" * 300, "--out", "s"], 3, "xxx", cwd=tmp_path)
    refuse(["score", "study", "--answers", "x" * 300], 3, "xxx", cwd=tmp_path)
    write_answers(tmp_path / "study", [sheet_of(study.plan, 0, source=BROWSER)])
    for flag in ("--json", "--markdown"):
        name = "key.json" if flag == "--json" else "study.json"
        argv = ["score", "study", flag, f"study/{name}", "--overwrite"]
        refuse(argv, 7, name, "a file of the study", cwd=tmp_path)
    (tmp_path / "old.json").write_text("{}")
    refuse(["score", "study", "--json", "old.json"], 7, "old.json", "exists", cwd=tmp_path)
    protocol = tmp_path / "study" / "study.json"
    text = protocol.read_text()
    protocol.write_text(text.replace('"most_catches_missed": 0', '"most_catches_missed": 1'))
    refuse(["score", "study"], 3, "study.json", "sha256 differs", cwd=tmp_path)
    protocol.write_text(text)
    key = tmp_path / "study" / "key.json"
    whole = json.loads(key.read_text())
    for damage in ({"raters": 3}, {"pairs": []}, {"format": 2}, {"seed": "x"}):
        key.write_text(json.dumps(whole | damage))
        refuse(["score", "study"], 3, "key.json", cwd=tmp_path)
    first = whole["raters"][0]
    for wrong in ({"token": []}, {"run": 2}, {"run": 10**100}, {"run": None}):
        key.write_text(json.dumps(whole | {"raters": [first | wrong, *whole["raters"][1:]]}))
        refuse(["score", "study"], 3, "key.json", "damaged", cwd=tmp_path)
    for wrong in ({"pair": -1}, {"pair": 0.0}, {"pair": 10**9}, {"id": {}}, {"a_side": 3}):
        trials = [first["trials"][0] | wrong, *first["trials"][1:]]
        changed = [first | {"trials": trials}, *whole["raters"][1:]]
        key.write_text(json.dumps(whole | {"raters": changed}))
        refuse(["score", "study"], 3, "key.json", "damaged", cwd=tmp_path)
    protocol.write_text(text.replace('"runs": 1', '"runs": 1000000000000'))
    digest = hashlib.sha256(protocol.read_bytes()).hexdigest()
    key.write_text(json.dumps(whole | {"protocol_sha256": digest}))
    refuse(["score", "study"], 3, "key.json", "1000000000000 runs", cwd=tmp_path)


def test_figures_replace_nothing_but_figures(
    scenes: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Neither the answers, under any of their names, nor a file of the study, nor each other."""
    monkeypatch.chdir(tmp_path)
    study = make(scenes, tmp_path / "study")
    (tmp_path / "back").mkdir()
    mine = tmp_path / "back" / "a.json"
    mine.write_text(json.dumps(sheet_of(study.plan, 0, source=BROWSER)))
    (tmp_path / "linked.json").symlink_to(mine)
    (tmp_path / "hard.json").hardlink_to(mine)
    (tmp_path / "alias").symlink_to(tmp_path / "study")
    page_name = next((tmp_path / "study" / "pages").glob("*.html")).name
    (tmp_path / "study" / "pages" / "out.md").symlink_to(tmp_path / "elsewhere.md")
    (tmp_path / "to-key.json").symlink_to(tmp_path / "study" / "key.json")

    def files() -> dict[Path, bytes]:
        return {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}

    before = files()
    named = ("linked.json", "hard.json", "to-key.json")
    kept = {path: content for path, content in before.items() if path.name not in named}
    for answers, targets, words in (
        ("back/a.json", ["--json", "back/a.json"], "a file of answers"),
        ("back/a.json", ["--markdown", "study/../back/a.json"], "a file of answers"),
        ("linked.json", ["--json", "back/a.json"], "a file of answers"),
        ("back", ["--json", "f", "--markdown", "f"], "the same file as --json"),
        ("back", ["--json", "f", "--markdown", "alias/../f"], "the same file as --json"),
        ("back", ["--json", f"study/pages/{page_name}"], "a file of the study"),
        ("back", ["--json", "study/answers/new.json"], "a file of the study"),
        ("back", ["--json", "study/new.json"], "a file of the study"),
        ("back", ["--markdown", "alias/pages/new/figures.md"], "a file of the study"),
        ("back", ["--markdown", "study/pages/out.md"], "a file of the study"),
        ("back", ["--json", "back"], "exists"),
    ):
        capsys.readouterr()
        argv = ["score", "study", "--answers", answers, "--overwrite", *targets]
        assert main(argv) == 7, argv
        errors = capsys.readouterr().err.splitlines()
        assert words in errors[0] and not any("Traceback" in line for line in errors), errors
        assert files() == before
    argv = ["score", "study", "--answers", "back", "--json", "f.json", "--markdown", "f.md"]
    assert main(argv) == 0 and main(argv) == 7 and main([*argv, "--overwrite"]) == 0
    # Other names of a file are replaced, and what they lead to is not.
    for name in named:
        argv = ["score", "study", "--answers", "back/a.json", "--overwrite", "--json", name]
        assert main(argv) == 0 and not (tmp_path / name).is_symlink()
    assert {path: content for path, content in files().items() if path in kept} == kept


def test_answers_of_people_are_scored_without_a_warning(scenes: Path, tmp_path: Path) -> None:
    """The form of what a browser saves; nobody's opinion here either, and thrown away."""
    study = make(scenes, tmp_path / "study")
    write_answers(tmp_path / "study", [sheet_of(study.plan, 0, source=BROWSER)])
    ended = run_case(["score", "study"], tmp_path, **AS_STUDY)
    assert ended.status == 0, ended
    assert "AUTOMATED" not in ended.out and "1 of 3 raters" in ended.out


# -------------------------------------------------------------------------------- the browser


def transforms(opened: Opened) -> tuple[str, str]:
    first, second = (
        opened.page.eval_on_selector(f"#image-{k}", "image => image.style.transform")
        for k in (1, 2)
    )
    return str(first), str(second)


def begin(opened: Opened) -> None:
    """Go from the first page to the first pair."""
    page = opened.page
    assert page.is_visible("#consent") and page.is_disabled("#to-instruction")
    page.get_by_label("I am 18 or older").check()
    page.get_by_role("button", name="Continue").click()
    assert page.is_visible("#instruction") and not page.is_visible("#consent")
    page.get_by_role("button", name="Begin").click()
    await_pair(opened, 1)


def await_pair(opened: Opened, number: int) -> None:
    """Wait until a pair is shown and listens."""
    opened.page.wait_for_function(
        "text => document.getElementById('progress-text').textContent.startsWith(text)"
        " && shownAt !== null && performance.now() - shownAt > deafMs",
        arg=f"Pair {number} of",
    )


def use_zoom(opened: Opened) -> None:
    """Enlarge by click, wheel and key, move, and see that both pictures follow."""
    page = opened.page
    whole = "translate(0%, 0%) scale(1)"
    assert transforms(opened) == (whole, whole)
    box = page.locator(".frame").nth(1).bounding_box()
    assert box is not None
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.click(*middle)
    clicked = transforms(opened)
    assert clicked == ("translate(-100%, -100%) scale(3)",) * 2
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + box["width"] / 4, middle[1])
    page.mouse.up()
    assert transforms(opened) == ("translate(-75%, -100%) scale(3)",) * 2
    page.keyboard.press("Shift+ArrowDown")
    assert transforms(opened) == ("translate(-75%, -110%) scale(3)",) * 2
    page.mouse.wheel(0, -100)
    page.wait_for_function("() => view.scale > 3")
    assert transforms(opened)[0] == transforms(opened)[1] != clicked[0]
    page.keyboard.press("0")
    assert transforms(opened) == (whole, whole)


def use_fingers(opened: Opened) -> None:
    """Spread two fingers, lift one, move the other; a third that comes meanwhile does nothing."""
    box = opened.page.locator(".frame").nth(0).bounding_box()
    assert box is not None
    fingers, view = Fingers(opened.page), "[view.scale, view.x, view.y]"
    left, top, width, height = (box[name] for name in ("x", "y", "width", "height"))

    def at(u: float, v: float) -> tuple[float, float]:
        return left + u * width, top + v * height

    fingers.press(0, *at(0.4, 0.5))
    fingers.press(1, *at(0.6, 0.5))
    fingers.move(1, *at(0.7, 0.5))
    fingers.press(2, *at(0.1, 0.1))
    fingers.move(2, *at(0.3, 0.3))
    fingers.move(1, *at(0.8, 0.5))
    # The points of the picture that are under the two are there still: twice as large.
    assert opened.page.evaluate(view) == pytest.approx([2.0, -0.4, -0.5], abs=0.02)
    fingers.lift(2)
    fingers.lift(1)
    fingers.move(0, *at(0.5, 0.5))
    assert opened.page.evaluate(view) == pytest.approx([2.0, -0.3, -0.5], abs=0.02)
    fingers.lift(0)
    assert opened.page.evaluate(view) == pytest.approx([2.0, -0.3, -0.5], abs=0.02)
    opened.page.keyboard.press("0")


def check_frames(opened: Opened) -> None:
    """Both pictures are of one size, apart, on grey."""
    frames = [opened.page.locator(".frame").nth(k).bounding_box() for k in (0, 1)]
    first, second = frames
    assert first is not None and second is not None
    assert (first["width"], first["height"]) == (second["width"], second["height"])
    assert second["x"] - (first["x"] + first["width"]) >= 30
    assert first["width"] / first["height"] == pytest.approx(WIDTH / HEIGHT, rel=0.01)
    color = "getComputedStyle(document.getElementById('trial')).backgroundColor"
    assert opened.page.evaluate(color) == "rgb(118, 118, 118)"


def answer_all(opened: Opened, count: int) -> None:
    """Choose picture 2 with a key, then 1 with a double click, and so on; load the page twice.

    A double click's second half comes when the next pair is there: it chooses nothing.
    """
    page = opened.page
    for number in range(1, count + 1):
        await_pair(opened, number)
        if number == 1:
            check_frames(opened)
            use_zoom(opened)
            use_fingers(opened)
        if number == 2:
            for _ in range(2):
                page.evaluate("sessionStorage.clear()")  # as Chromium has it for some reloads
                page.reload()
                await_pair(opened, number)
        if number % 2:
            page.keyboard.press("2" if number == 1 else "ArrowRight")
        else:
            page.locator("#choose-1").click()
            if number < count:
                await_pair(opened, number + 1)
            page.mouse.down(click_count=2)
            page.mouse.up(click_count=2)
    page.wait_for_selector("#last", state="visible")


def check_sheet_of_browser(path: Path, study: Study) -> None:
    record = json.loads(path.read_text())
    sheet = check_sheet(path, record, study.plan)
    assert sheet.is_automated and record["resumed"] == 2
    assert [answer["choice"] for answer in record["answers"]] == [
        2 if k % 2 == 0 else 1 for k in range(len(record["answers"]))
    ]
    assert [a.zoomed for a in sheet.answers] == [k == 0 for k in range(len(sheet.answers))]
    assert all(0.4 <= a.seconds < 60 for a in sheet.answers)


@pytest.mark.slow
@needs_chromium
def test_a_study_from_consent_to_figures(
    scenes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Pages that were copied somewhere, without a server; the answers are a download."""
    study = make(scenes, tmp_path / "study")
    copied = tmp_path / "copied"
    shutil.copytree(tmp_path / "study" / "pages", copied)
    rater = study.plan.raters[0]
    with open_browser(390, 800) as opened:
        opened.page.goto((copied / f"{rater.token}.html").as_uri())
        opened.page.set_viewport_size({"width": 1280, "height": 800})
        begin(opened)
        opened.page.get_by_role("button", name="Stop").click()
        opened.page.keyboard.press("1")  # a dialog is open: nothing is chosen
        opened.page.get_by_role("button", name="Stop and discard").click()
        assert opened.page.is_visible("#stopped")
        assert opened.page.evaluate("sessionStorage.length") == 0
        assert opened.page.evaluate("history.state") is None
        opened.page.reload()
        begin(opened)
        opened.page.get_by_role("button", name="Photo without the object").click()
        assert opened.page.is_visible("#image-photo")
        opened.page.get_by_role("button", name="Photo without the object").click()
        assert opened.page.is_hidden("#image-photo")
        answer_all(opened, len(rater.trials))
        with opened.page.expect_download() as downloading:
            opened.page.get_by_role("button", name="Download my answers").click()
        assert downloading.value.suggested_filename == f"answers-{rater.token}.json"
        downloading.value.save_as(tmp_path / "back" / "a.json")
        opened.page.set_viewport_size({"width": 380, "height": 800})
        assert opened.page.evaluate("document.documentElement.scrollWidth") <= 380
    assert opened.errors == []
    assert all(url.startswith("file:///") for url in opened.requests)
    check_sheet_of_browser(tmp_path / "back" / "a.json", study)
    argv = ["score", "study", "--answers", "back"]
    refuse(argv, 3, "a.json", "answered by a program", cwd=tmp_path)
    capsys.readouterr()
    report = score(tmp_path / "study", "--answers", str(tmp_path / "back"))
    assert report["sheets"]["found"] == report["sheets"]["automated"] == 1
    assert capsys.readouterr().out.startswith(WARNING)
