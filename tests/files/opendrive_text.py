"""OpenDRIVE text of single roads."""

WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'


def lane(i, before=None, after=None, more=""):
    links = "".join(
        f'<{tag} id="{k}"/>' for tag, k in (("predecessor", before), ("successor", after)) if k
    )
    return f'<lane id="{i}" type="driving" {more}><link>{links}</link>{WIDTH}</lane>'


def section(s, *lanes, more=""):
    sides = {"left": [], "right": []}
    for one in lanes:
        sides["right" if 'id="-' in one else "left"].append(one)
    body = "".join(f"<{side}>{''.join(some)}</{side}>" for side, some in sides.items() if some)
    return f'<laneSection s="{s}" {more}>{body}</laneSection>'


def road(
    i,
    *sections,
    x=0.0,
    length=50.0,
    junction="-1",
    before="",
    after="",
    view="",
):
    """Write a road along x; ``before`` and ``after`` name what joins it: ``road:2:start``."""
    links = ""
    for tag, text in (("predecessor", before), ("successor", after)):
        if text:
            kind, target, *contact = text.split(":")
            point = f'contactPoint="{contact[0]}"' if contact else ""
            links += f'<{tag} elementType="{kind}" elementId="{target}" {point}/>'
    view = view or f'<geometry s="0" x="{x}" y="0" hdg="0" length="{length}"><line/></geometry>'
    return f'<road id="{i}" length="{length}" junction="{junction}"><link>{links}</link><planView>{view}</planView><lanes>{"".join(sections)}</lanes></road>'
