"""The fields of OpenDRIVE (1.4 to 1.8) that are read, and those that change nothing of a road."""

from alpasim_plugin.core.files.fields import Fields

_CUBIC = "@a @b @c @d"
_SIDE = "lane"
_PLACE = "@s @t"
OPENDRIVE = Fields(
    "OpenDRIVE",
    read={
        # Other elements of the root, and the offset of the header, have notes of their own.
        "OpenDRIVE": "header road junction controller",
        "header": "geoReference offset",
        "road": """@id @length @junction @rule link type planView elevationProfile lateralProfile
            lanes objects signals""",
        "link": "predecessor successor",
        **dict.fromkeys(("predecessor", "successor"), "@elementType @elementId @contactPoint @id"),
        "type": "@s speed",
        "speed": "@max @unit @sOffset",
        "planView": "geometry",
        "geometry": "@s @x @y @hdg @length line arc spiral poly3 paramPoly3",
        "arc": "@curvature",
        "spiral": "@curvStart @curvEnd",
        "poly3": _CUBIC,
        "paramPoly3": "@aU @bU @cU @dU @aV @bV @cV @dV @pRange",
        "elevationProfile": "elevation",
        "lateralProfile": "superelevation shape",
        **dict.fromkeys(("elevation", "superelevation", "laneOffset"), f"@s {_CUBIC}"),
        "lanes": "laneOffset laneSection",
        "laneSection": "@s @singleSide left center right",
        **dict.fromkeys(("left", "center", "right"), _SIDE),
        "lane": "@id @type @level @direction link width border roadMark speed access userData",
        "userData": "vectorLane",
        "vectorLane": "@travelDir",
        "access": "@sOffset @rule @restriction restriction",
        "restriction": "@type",
        **dict.fromkeys(("width", "border"), f"@sOffset {_CUBIC}"),
        "roadMark": "@type @color",
        "objects": "object",
        "object": f"@type @name @subtype {_PLACE} @hdg outline outlines",
        "outlines": "outline",
        "outline": "cornerLocal cornerRoad",
        "cornerLocal": "@u @v",
        "cornerRoad": _PLACE,
        "signals": "signal signalReference",
        "signal": f"""@id @type @dynamic {_PLACE} @zOffset @orientation @width @height @name
            @subtype validity""",
        "signalReference": f"@id {_PLACE} @orientation validity",
        "validity": "@fromLane @toLane",
        "junction": "@id @type connection",
        "connection": "@incomingRoad @connectingRoad @linkedRoad @contactPoint laneLink",
        "laneLink": "@from @to",
        "controller": "@id control",
        "control": "@signalId",
    },
    harmless={
        "OpenDRIVE": "junctionGroup station userData include",
        "header": """@revMajor @revMinor @name @version @date @north @south @east @west @vendor
            userData license defaultRegulations""",
        "offset": "@x @y @z @hdg",
        "geometry": "userData",
        "road": "@name userData surface dataQuality",
        "type": "@type @country userData",
        "laneSection": "userData",
        "shape": f"{_PLACE} {_CUBIC}",  # a note of its own counts them
        "lane": "material @roadWorks @dynamicLaneDirection @dynamicLaneType",
        "userData": "@code @value fillet style",
        "vectorLane": "@sOffset @laneId predecessor successor",
        "roadMark": """@sOffset @weight @material @width @laneChange @height type sway explicit
            userData""",
        "lanes": "userData",
        # What is beside the road; each type of object has a note of its own.
        "object": """@id @length @width @height @radius @orientation @zOffset @pitch @roll @dynamic
            @validLength @perpToRoad repeat parkingSpace material markings borders surface skeleton
            userData validity""",
        "outline": "@id @closed @outer @laneType @fillType",
        "cornerLocal": "@id @z @height",
        "cornerRoad": "@id @dz @height",
        "objects": "bridge tunnel objectReference",
        # Signs are shown by their type and are not obeyed.
        "signal": """@country @countryRevision @hOffset @pitch @roll @unit @value @text @length
            userData dependency reference semantics""",
        "signalReference": "userData",
        "junction": "@name @mainRoad @orientation @sStart @sEnd userData controller surface",
        "connection": "@id @type",
        "controller": "@name @sequence userData",
        "control": "@type",
    },
)
