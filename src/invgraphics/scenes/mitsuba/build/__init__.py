"""Procedural models, one builder per scene; plain numpy, so that nothing is downloaded and Mitsuba is not needed here."""

BUILDERS = {
    "bricks": "invgraphics.scenes.mitsuba.build.bricks:build",
    "chairs": "invgraphics.scenes.mitsuba.build.chairs:build",
    "cloud": "invgraphics.scenes.mitsuba.build.cloud:build",
    "cloud-1": "invgraphics.scenes.mitsuba.build.cloud:build_1",
    "cloud-27": "invgraphics.scenes.mitsuba.build.cloud:build_27",
    "cloud-3": "invgraphics.scenes.mitsuba.build.cloud:build_3",
    "cloud-81": "invgraphics.scenes.mitsuba.build.cloud:build_81",
    "fence": "invgraphics.scenes.mitsuba.build.fence:build",
    "materials": "invgraphics.scenes.mitsuba.build.materials:build",
    "mugs": "invgraphics.scenes.mitsuba.build.mugs:build",
    "room": "invgraphics.scenes.mitsuba.build.room:build",
    "shelf": "invgraphics.scenes.mitsuba.build.shelf:build",
    "textured": "invgraphics.scenes.mitsuba.build.textured:build",
}
"""Builder name -> function that takes the scene's seed and returns a `Model`."""
