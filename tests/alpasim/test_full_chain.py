"""The whole chain: our loop, our renderer service with the fixer, another renderer behind it, our
driver service, a score.
"""

from concurrent import futures
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache

import grpc
import numpy as np
import pytest
import yaml
from numpy.testing import assert_array_equal

from alpasim_plugin.alpasim.server.assembly import Settings, Upstream, assemble
from alpasim_plugin.alpasim.server.driver_service import DriverService
from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.log import decode_image
from alpasim_plugin.log.images import encode_image
from alpasim_plugin.log.wire import SERVICE_PATHS
from alpasim_plugin.log.wire.services import OPTIONS, handlers, methods
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from alpasim_plugin.runs.score_logs import scenario_finder
from evaluators import reduce_rollout, score
from evaluators.metrics.presets import preset
from scenarios.load import load_scenario
from scenarios.suite import shipped_names
from tests.alpasim.service_cases import trust_every_frame

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    written = yaml.safe_load(shipped_names()["smoke/curve"].read_text())
    path = tmp_path_factory.mktemp("scenes") / "curve.yaml"
    timing = {"duration_us": 400_000, "warmup_us": 200_000}
    camera = {"width": 96, "height": 64, "name": "front"}
    path.write_text(
        yaml.safe_dump(written | {"scene_id": "chain-curve", "timing": timing, "cameras": [camera]})
    )
    return str(path)


class Inside:
    """A channel without a socket: a call runs the implementation in the caller's thread. Messages
    are serialised all the same.
    """

    def __init__(self, services):
        self._services = {SERVICE_PATHS[name]: (name, one) for name, one in services.items()}

    def unary_unary(
        self,
        path,
        request_serializer,
        response_deserializer,
    ):
        prefix, _, call = path.rpartition("/")
        name, one = self._services.get(f"{prefix}/", ("", None))

        def ask(request, timeout=None, wait_for_ready=False):
            got = methods(name)[call].request.FromString(request_serializer(request))
            return response_deserializer(getattr(one, call)(got, Caller()).SerializeToString())

        return ask

    def close(self):
        """Nothing is open."""


class Caller:
    """The context of a call without a socket."""

    def time_remaining(self):
        return None

    def is_active(self):
        return True

    def add_callback(self, callback):
        return True

    def abort(self, code, text):
        raise AssertionError(f"{code}: {text}")


@dataclass
class Network:
    """Where services are: behind sockets, or inside."""

    monkeypatch: pytest.MonkeyPatch
    over_sockets: bool
    stack: ExitStack

    def add(self, services):
        if self.over_sockets:
            server = grpc.server(futures.ThreadPoolExecutor(4), options=list(OPTIONS))
            server.add_generic_rpc_handlers(
                tuple(handlers(name, one) for name, one in services.items())
            )
            port = server.add_insecure_port("127.0.0.1:0")
            server.start()
            self.stack.callback(server.stop, 0)
            return f"127.0.0.1:{port}"
        known = getattr(self, "known", {})
        self.known = known
        address = f"inside:{len(known)}"
        known[address] = Inside(services)
        self.monkeypatch.setattr("grpc.insecure_channel", lambda target, options=(): known[target])
        self.monkeypatch.setattr(
            "alpasim_plugin.alpasim.client.channel.Service.wait_ready", lambda service: None
        )
        return address


@pytest.fixture(scope="module")
def renderer(scene):
    """The service behind: frames of the scene as built, whoever asks."""
    return assemble(Settings(renderer="clean", scenes=(scene,))).services


@contextmanager
def chain(network, scene, renderer, overrides):
    """Start the services; give the addresses of the fixed renderer, the one behind it, and the
    driver.
    """
    trust_every_frame(network.monkeypatch)
    base = network.add(renderer)
    front = assemble(
        Settings(
            overrides=overrides,
            scenes=(scene,),
            upstream=Upstream(base),
        )
    )
    spec = resolve("policy", "lane-camera")
    driver = DriverService(
        spec.name,
        spec.digest,
        lambda scenario: build(spec, scenario=scenario),
        scenario_finder([scene]),
    )
    yield (
        network.add({"SensorsimService": front.service}),
        base,
        network.add({"EgodriverService": driver}),
    )
    front.close()


@cache
def loaded(scene):
    return load_scenario(scene)


def drive(scene, renderer, policy, overrides=None, seed=0):
    scenario = loaded(scene)
    with Recorder(scenario, seed, images="png") as recorder:
        made = make_renderer(renderer, scenario, seed, threads=1, overrides=overrides or ())
        run_rollout(
            scenario, made, build(resolve("policy", policy), scenario=scenario), seed, recorder
        )
    return recorder.log()


def measured(rollout, scene):
    series = score(rollout, loaded(scene).scene, preset("paper"))
    return {name: one.value for name, one in reduce_rollout(series, preset("paper")).values.items()}


def both(
    scene,
    renderer,
    overrides,
    encoding,
    monkeypatch,
    renderers,
):
    """Drive every renderer over sockets, then without any; ``{front}`` and ``{base}`` in a name are
    the services' addresses.
    """
    logs = []
    for over_sockets in (True, False):
        with (
            ExitStack() as stack,
            chain(Network(monkeypatch, over_sockets, stack), scene, renderer, overrides) as (
                front,
                base,
                driver,
            ),
        ):
            own = [*overrides, "noise=content"]
            names = [name.format(front=front, base=base) for name in renderers]
            policy = f"alpasim://{driver}?encoding={encoding}"
            logs.append(
                [
                    drive(scene, name, policy, own if name.startswith("onefixer") else None)
                    for name in names
                ]
            )
        monkeypatch.undo()
    return logs


def assert_equal(one, other, scene):
    assert_array_equal(one.ego.xyz, other.ego.xyz)
    assert_array_equal(one.ego.quat, other.ego.quat)
    assert [image.data for image in one.images] == [image.data for image in other.images]
    assert measured(one, scene) == measured(other, scene)


def apart(one, other, frames):
    """Return the mean absolute difference of the first frames, in grey levels."""
    pairs = zip(one.images[:frames], other.images[:frames], strict=True)
    return float(
        np.mean(
            [
                np.abs(decode_image(a.data).astype(int) - decode_image(b.data).astype(int)).mean()
                for a, b in pairs
            ]
        )
    )


def test_the_chain_over_sockets_equals_the_chain_in_one_process(
    scene, renderer, overrides, monkeypatch
):
    pictures = ["nre://{front}?encoding=png", "onefixer+nre://{base}"]
    (served, fixed_here), (inside, fixed_inside) = both(
        scene, renderer, overrides, "png", monkeypatch, pictures
    )
    assert_equal(served, inside, scene)  # exactly: images, poses and scores
    assert_equal(fixed_here, fixed_inside, scene)
    # A fixer in our process draws its semantic map at float64 poses, the served one at those of the
    # wire.
    assert np.abs(fixed_here.ego.xyz - served.ego.xyz).max() < 1e-4
    assert apart(fixed_here, served, 99) < 0.05
    jpegs = ["nre://{front}?encoding=jpeg", "nre://{base}"]
    (jpeg, raw), (jpeg_inside, _) = both(scene, renderer, overrides, "jpeg", monkeypatch, jpegs)
    assert apart(raw, served, 3) > 0.2  # the fixer was there
    assert_equal(jpeg, jpeg_inside, scene)
    for one, other in zip(
        jpeg.images[:3], served.images[:3], strict=True
    ):  # in the warm-up, at equal poses: the codec alone
        coded = decode_image(encode_image(decode_image(other.data), "jpeg"))
        assert_array_equal(decode_image(one.data), coded)
