from .gsplat import rasterization as rasterization
