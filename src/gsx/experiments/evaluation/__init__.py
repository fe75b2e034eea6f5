"""Evaluation on held-out views, and remarks for the reader of its figures."""
