"""Register the parts that another process serves."""

from alpasim_plugin.core.parts.registry import RegisteredPart

PARTS = (
    RegisteredPart(
        kind="renderer",
        name="nre://",
        target="alpasim_plugin.alpasim.client.renderer:NreRenderer",
        help="an AlpaSim renderer service: nre://HOST:PORT[?scene=ID]",
    ),
    RegisteredPart(
        kind="policy",
        name="alpasim://",
        target="alpasim_plugin.alpasim.client.driver:AlpasimPolicy",
        help="an AlpaSim driver: alpasim://HOST:PORT[?cameras=THEIRS:OURS,...]",
    ),
    RegisteredPart(
        kind="policy",
        name="exec:",
        target="alpasim_plugin.alpasim.client.command:CommandPolicy",
        help="a command that serves a policy, in another environment or a container: 'exec:python my_policy.py'",
    ),
)
