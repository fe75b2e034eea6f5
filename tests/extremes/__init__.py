"""The extremes suite: named cases (`cases.py`), how they are compared (`comparison.py`), and a search."""
