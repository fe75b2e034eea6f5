"""Names of axes: Right or Left, Up or Down, Front or Back for x, y, z, as in Niantic's library."""

TRAINED, SPECIFIED = "rdf", "rub"
"""Axes of training worlds (COLMAP, OpenCV) and of SPZ (OpenGL, three.js)."""
AUTO = "auto"
"""Axes that the file states, else those that fit the scene, else those of the format."""
SYSTEMS = (
    *("ldb", "rdb", "lub", "rub", "ldf", "rdf", "luf", "ruf"),
    *("lfd", "rfd", "lfu", "rfu", "lbd", "rbd", "lbu", "rbu"),
)
"""Names by code - 1 in SPZ's extension SPZ_ADOBE_coordinate_system (nianticlabs/spz, splat-types.h)."""
FIXED = "fixed"
"""Reason for the axes of a glTF, whose format fixes them."""
CHOICES = (AUTO, *SYSTEMS)
"""Values of `axes`."""
EXAMPLES = "auto, rub (SPZ as specified), rdf (as trained), or another of three letters, for example ruf"
