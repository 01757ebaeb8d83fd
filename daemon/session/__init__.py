"""The record of a flight: one folder and one SQLite database each, append-only, safe against kill -9.

``rows`` what is recorded, ``schema`` and ``database`` how, ``reader`` and ``store`` the way in,
``library`` where flights live and what is unfinished, ``export`` a copy to take away.
"""
