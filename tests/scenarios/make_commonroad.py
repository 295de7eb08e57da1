"""Writes small CommonRoad documents: two parallel lanelets with a successor each, and cars that
drive along them.
"""


def points(*xy):
    return "".join(f"<point><x>{x}</x><y>{y}</y></point>" for x, y in xy)


def bound(tag, *xy, marking=""):
    return f"<{tag}>{points(*xy)}{marking and f'<lineMarking>{marking}</lineMarking>'}</{tag}>"


def lanelet(number, x0, x1, y, rest="", left="", right=""):
    upper = bound("leftBound", (x0, y + 2), (x1, y + 2), marking=left)
    lower = bound("rightBound", (x0, y - 2), (x1, y - 2), marking=right)
    return f'<lanelet id="{number}">{upper}{lower}{rest}</lanelet>'


def state(step, x, y, yaw=0.0, speed=10.0, tag="state"):
    return (
        f"<{tag}><position><point><x>{x}</x><y>{y}</y></point></position><orientation><exact>{yaw}</exact></orientation>"
        f"<time><exact>{step}</exact></time><velocity><exact>{speed}</exact></velocity></{tag}>"
    )


RECTANGLE = "<rectangle><length>4.4</length><width>1.8</width></rectangle>"


def body(states, shape=RECTANGLE, kind="car"):
    first, *rest = states
    path = f"<trajectory>{''.join(rest)}</trajectory>" if rest else ""
    return (
        f"<type>{kind}</type><shape>{shape}</shape>{first.replace('state>', 'initialState>')}{path}"
    )


def drive(x0, y, speed=10.0, steps=range(21)):
    return [state(k, x0 + speed * 0.1 * k, y, speed=speed) for k in steps]


def obstacle(number, states, shape=RECTANGLE, kind="car", version="2018b", static=False):
    if version == "2018b":
        return f'<obstacle id="{number}"><role>{"static" if static else "dynamic"}</role>{body(states, shape, kind)}</obstacle>'
    tag = "staticObstacle" if static else "dynamicObstacle"
    return f'<{tag} id="{number}">{body(states, shape, kind)}</{tag}>'


LANES = (
    lanelet(
        1,
        0,
        60,
        0,
        '<successor ref="2"/><adjacentLeft ref="3" drivingDir="same"/><speedLimit>13.5</speedLimit>',
    )
    + lanelet(2, 60, 200, 0, '<predecessor ref="1"/>')
    + lanelet(3, 0, 200, 4, '<adjacentRight ref="1" drivingDir="same"/>')
)
TRAFFIC = (
    obstacle(11, drive(20, 0))
    + obstacle(12, drive(45, 4, speed=8.0))
    + obstacle(13, drive(60, 0, speed=12.0, steps=range(11)))
)


def document(
    lanes=LANES, traffic=TRAFFIC, version="2018b", dt="0.1", name="ZAM_Test-1_1_T-1", more=""
):
    head = f'<commonRoad commonRoadVersion="{version}" timeStepSize="{dt}" benchmarkID="{name}">'
    return f'<?xml version="1.0" encoding="utf-8"?>\n{head}{lanes}{traffic}{more}</commonRoad>'


def write_commonroad(path, **parts):
    path.write_text(document(**parts), encoding="utf-8")
    return path
