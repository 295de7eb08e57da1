"""The fields of CommonRoad XML (2018b and 2020a) that are read, and those that change nothing."""

from alpasim_plugin.core.files.fields import Fields

_POINT = {"point": "x y z"}
_STATE = "position orientation time"
_MOTION = """velocity acceleration yawRate slipAngle steeringAngle steeringAngleSpeed jerk curvature
    velocityY accelerationY frontWheelAngularSpeed rearWheelAngularSpeed"""  # that of the positions is taken
_OBSTACLE = "@id type shape initialState trajectory"
_BOUND = "point lineMarking"
COMMONROAD = Fields(
    "CommonRoad",
    read={
        "commonRoad": """@commonRoadVersion @benchmarkID @timeStepSize lanelet trafficSign
            trafficLight obstacle staticObstacle dynamicObstacle""",
        "lanelet": """@id leftBound rightBound predecessor successor adjacentLeft adjacentRight
            stopLine laneletType trafficSignRef trafficLightRef speedLimit userOneWay
            userBidirectional""",
        "leftBound": _BOUND,
        "rightBound": _BOUND,
        "stopLine": "point trafficLightRef",
        **dict.fromkeys(("successor", "trafficSignRef", "trafficLightRef"), "@ref"),
        **dict.fromkeys(("adjacentLeft", "adjacentRight"), "@ref @drivingDir"),
        "trafficSign": "@id trafficSignElement",
        "trafficSignElement": "trafficSignID additionalValue",
        "trafficLight": "@id cycle active direction",
        "cycle": "cycleElement timeOffset",
        "cycleElement": "color duration",
        "obstacle": f"{_OBSTACLE} role",
        "staticObstacle": _OBSTACLE,
        "dynamicObstacle": _OBSTACLE,
        "shape": "rectangle circle polygon",
        "rectangle": "length width orientation center originXShift",
        "circle": "radius center",
        "center": "x y",
        "polygon": "point",
        "trajectory": "state",
        "state": _STATE,
        "initialState": _STATE,
        "position": "point",
        "orientation": "exact",
        "time": "exact",
        **_POINT,
    },
    harmless={
        # Named by notes of their own: the planning problem, and obstacles without a track.
        "commonRoad": """@author @affiliation @source @date @tags planningProblem
            environmentObstacle phantomObstacle scenarioTags location intersection""",
        "predecessor": "@ref",
        "stopLine": "lineMarking trafficSignRef",
        "trafficSign": "position virtual",
        "trafficLight": "position",
        "obstacle": "occupancySet",
        "dynamicObstacle": "occupancySet",
        "state": _MOTION,
        "initialState": _MOTION,
    },
)
