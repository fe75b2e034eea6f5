"""The built-in scene: a small garden still life, ray-cast in closed form, with exact truth at any zoom and crop."""

from gsx.scenes.demo.views import DemoOptions, DemoSource, RayCastOptions, load

__all__ = ["DemoOptions", "DemoSource", "RayCastOptions", "load"]
