"""Point clouds and height models of other programs: read in pieces, written moved."""

from calib.clouds.cloud import CloudFile, Kind, LoadedCloud, chunks, load_cloud, open_cloud, rewrite

__all__ = ["CloudFile", "Kind", "LoadedCloud", "chunks", "load_cloud", "open_cloud", "rewrite"]
