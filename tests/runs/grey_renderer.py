"""A renderer that costs nothing: for runs whose subject is what happens to rollouts, not what they
show.
"""

import numpy as np

from alpasim_plugin.core.types import Frame

GREY = "tests.runs.grey_renderer:Grey"


class Grey:
    """One grey level."""

    level = 90

    def render(self, request):
        shape = (request.camera.height, request.camera.width, 3)
        return Frame(request.t_us, request.camera.name, np.full(shape, self.level, dtype=np.uint8))


class Darker(Grey):
    """A darker one."""

    level = 30
