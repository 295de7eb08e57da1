"""Where third-party data sets lie: their licences keep them out of this repository."""

import os
from pathlib import Path

REPO = Path(__file__).resolve().parents[1]


def shared_folder():
    """Return the folder of data sets, which need not exist: ``SIMRUN_SHARED_DATA`` names it;
    otherwise it is ``../shared/data`` beside the checkout.
    """
    named = os.environ.get("SIMRUN_SHARED_DATA")
    return Path(named) if named else REPO.parent / "shared" / "data"
