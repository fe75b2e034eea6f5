"""The table of the extremes suite, which benchmarks/extremes.py writes into docs/benchmarks/extremes.md."""

BEGIN, END = "<!-- extremes: written by benchmarks/extremes.py -->\n", "<!-- end of extremes -->\n"
PATHS = ("eager", "compiled")
COLUMNS = ["case", *(f"{kind}, {path}" for path in PATHS for kind in ("image", "gradient")), "what happens"]


def rewritten(page: str, table: list[list[str]]) -> str:
    """The page with its table replaced."""
    before, rest = page.split(BEGIN)
    after = rest.split(END)[1]
    lines = "".join(f"| {' | '.join(cells)} |\n" for cells in table)
    return f"{before}{BEGIN}{lines}{END}{after}"


def read(page: str) -> list[list[str]]:
    """The rows of the page's table, below its header."""
    lines = page.split(BEGIN)[1].split(END)[0].splitlines()[2:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
