"""What the documentation shows runs, and does what it says."""

import re
from pathlib import Path

DOCS = Path(__file__).parent.parent / "docs"


def blocks(page):
    """The Python examples of a page."""
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)


def test_the_fit_of_the_rasterizer_page(capsys):
    """Every loss falls, and the numbers printed are about those of the page, which are a CPU's."""
    page = (DOCS / "rasterizing.md").read_text(encoding="utf-8")
    example = next(block for block in blocks("rasterizing.md") if "def step()" in block)
    exec(compile(example, "docs/rasterizing.md", "exec"), {})
    printed = [[float(word) for word in line.split()] for line in capsys.readouterr().out.splitlines()]
    shown = re.search(r"prints, on a CPU:\n\n```\n(.*?)```", page, re.DOTALL).group(1)
    expected = [[float(word) for word in line.split()] for line in shown.splitlines()]
    assert [row[0] for row in printed] == [row[0] for row in expected] == [0, 100, 200]
    assert printed[0] == expected[0]
    for start, end in zip(printed[0][1:], printed[-1][1:], strict=True):
        assert end < 0.2 * start


def test_the_example_of_the_tracking_page():
    """Joints that moved away from the middle by a tenth carry the skins along, and every force arrives at one."""
    scope = {}
    exec(compile(blocks("tracking.md")[0], "docs/tracking.md", "exec"), scope)
    length = (scope["moved"].numpy() ** 2).sum(axis=1) ** 0.5
    # x' = x + 0.1 sum w x_a: the mean of joints within 2 spacings of 0.16 lies at most 0.06 below the sphere of 0.8
    assert abs(length / 0.88 - 1.0).max() < 0.1 * 0.06 / 0.88
    assert scope["energy"].numpy()[0] > 0.0
    assert abs(scope["to_positions"].numpy().sum(axis=0) - 5000.0).max() < 0.1
