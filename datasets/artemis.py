"""Artemis / DFA folders: the writer (the reader follows)."""

from rewild4d.datasets.artemis_writer import ArtemisWriter

__all__ = ["ArtemisWriter"]
