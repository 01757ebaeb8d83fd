"""Which cameras are known to expose all rows at once, or so nearly that flying does not show."""

from __future__ import annotations

import re

#: By the name in the file. Of drones' cameras those with a mechanical (leaf) or a global shutter, as their
#: makers' data sheets have it; carried cameras whose stills end with a leaf or a curtain of few milliseconds.
_MECHANICAL = (
    r"FC6310\w?",  # Phantom 4 Pro, Advanced, RTK
    r"FC6360",  # Phantom 4 Multispectral
    r"FC6510",  # Zenmuse X4S
    r"FC6540",  # Zenmuse X7
    r"Zenmuse ?P1",
    r"M3E",  # Mavic 3 Enterprise, wide
    r"M3M",  # Mavic 3 Multispectral
    r"M4E",  # Matrice 4 Enterprise, wide
    r"S\.O\.D\.A\.\S*",
    r"PowerShot \S.*",
    r"Canon EOS \S.*",
    r"NIKON (D\d\S*|1 \S+|COOLPIX A)",
    r"ILCE-\S+",
    r"NEX-\S+",
    r"DSC-RX\S+",
    r"GR( II| III.*| DIGITAL.*)?",
    r"PENTAX \S.*",
)
_KNOWN = re.compile(rf"(^|\s)({'|'.join(_MECHANICAL)})$", re.IGNORECASE)


def shows_no_readout(camera_name: str) -> bool:
    """Whether a camera is known to have no rolling shutter that flying could show.

    ``camera_name`` as in ``CameraIdentity.name``. False: it has one, or nobody knows.
    """
    return _KNOWN.search(camera_name.strip()) is not None
