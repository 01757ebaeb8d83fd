"""Point clouds and height models of other programs: read in pieces, written moved."""

from calib.clouds.cloud import LoadedCloud, chunks, load_cloud, open_cloud, rewrite
from calib.clouds.kinds import CloudFile, Kind

__all__ = ["CloudFile", "Kind", "LoadedCloud", "chunks", "load_cloud", "open_cloud", "rewrite"]
