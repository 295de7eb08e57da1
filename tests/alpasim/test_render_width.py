"""A smaller image may be rendered and enlarged to the size asked for."""

import cv2
import numpy as np
import pytest

from alpasim_plugin.alpasim.server.assembly import Settings, assemble
from alpasim_plugin.alpasim.server.status import CallTime
from alpasim_plugin.log.images import decode_image
from tests.alpasim.local_service import SCENE, ask
from tests.examples import first_of


def frames(requests, **settings):
    made = assemble(Settings(scenes=[SCENE], **settings))  # type: ignore[arg-type]
    return [made.service.frames.answers([asked], CallTime())[0] for asked in requests]


@pytest.mark.slow
@pytest.mark.parametrize("renderer", first_of(["clean", "onefixer+clean"]))
def test_a_smaller_picture_is_enlarged_to_the_size_asked_for(renderer, overrides):
    given = {} if renderer == "clean" else {"overrides": overrides}
    asked = [ask(1.0 + 0.1 * i) for i in range(2)]
    small = [ask(1.0 + 0.1 * i) for i in range(2)]
    for one in small:
        one.resolution_w = one.resolution_w // 2
        one.resolution_h = one.resolution_h // 2
    size = asked[0].resolution_w, asked[0].resolution_h
    got = [
        decode_image(data)
        for data in frames(asked, renderer=renderer, render_width=size[0] // 2, **given)
    ]
    for image, half in zip(got, frames(small, renderer=renderer, **given), strict=True):
        np.testing.assert_array_equal(
            image, cv2.resize(decode_image(half), size, interpolation=cv2.INTER_CUBIC)
        )
    assert frames(small, renderer=renderer, render_width=size[0], **given) == frames(
        small, renderer=renderer, **given
    )
