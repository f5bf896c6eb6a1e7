"""Gaussians as Blender draws them: points with attributes, a disc at each by geometry nodes, and their material."""

from __future__ import annotations

import bpy
import numpy as np

ATTRIBUTES = {
    "position": ("FLOAT_VECTOR", "vector", "positions"),
    "rotation": ("QUATERNION", "value", "orientations"),
    "scale": ("FLOAT_VECTOR", "vector", "scales"),
    "opacity": ("FLOAT", "value", "opacities"),
    "base_color": ("FLOAT_COLOR", "color", "base_color"),
    "roughness": ("FLOAT", "value", "roughness"),
    "ambient_occlusion": ("FLOAT", "value", "ambient_occlusion"),
    "shading_normal": ("FLOAT_VECTOR", "vector", "normals"),
}
"""Type of each attribute of a point, its field in Blender's API, and the array that it holds."""

ALPHA_MIN, ALPHA_MAX = 1.0 / 255.0, 0.99
REACH = float(np.sqrt(-2.0 * np.log(ALPHA_MIN)))
"""Half the side of a disc's square, in standard deviations: outside, alpha is below `ALPHA_MIN`."""

OFFSET, CENTER = "gaussian_offset", "gaussian_center"
LAYER = 2.0 * REACH
"""A disc is passed from behind by rays that start this near to its centre, in its largest standard deviations: discs of
one surface overlap, and rays that leave it would end at its own."""


def fill(mesh: bpy.types.Mesh, arrays: dict[str, np.ndarray]) -> None:
    """Put Gaussians into a mesh of points, which is given as many vertices as there are."""
    count = len(arrays["positions"])
    if len(mesh.vertices) != count:
        mesh.clear_geometry()
        mesh.vertices.add(count)
    columns = dict(arrays)
    columns["orientations"] = np.roll(arrays["orientations"], 1, axis=1)  # Blender has w first
    columns["base_color"] = np.concatenate([arrays["base_color"], np.ones((count, 1), np.float32)], axis=1)
    for name, (kind, field, source) in ATTRIBUTES.items():
        attribute = mesh.attributes.get(name) or mesh.attributes.new(name, kind, "POINT")
        attribute.data.foreach_set(field, np.ascontiguousarray(columns[source], np.float32).ravel())
    mesh.update()


def _linked(tree: bpy.types.NodeTree, kind: str, inputs: dict, **settings: object) -> bpy.types.Node:
    """Add a node: inputs by name or number are values, or sockets to link."""
    node = tree.nodes.new(kind)
    for name, value in settings.items():
        setattr(node, name, value)
    for name, value in inputs.items():
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, node.inputs[name])
        else:
            node.inputs[name].default_value = value
    return node


def disc_nodes(material: bpy.types.Material) -> bpy.types.NodeTree:
    """Return the geometry nodes that put a square, across the thinnest axis, at each point."""
    tree = bpy.data.node_groups.new("Relightable discs", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")

    def named(name: str, kind: str) -> bpy.types.NodeSocket:
        node = _linked(tree, "GeometryNodeInputNamedAttribute", {"Name": name}, data_type=kind)
        return next(each for each in node.outputs if each.enabled and each.name == "Attribute")

    given = tree.nodes.new("NodeGroupInput").outputs[0]
    side = 2.0 * REACH
    sizes = {"Size X": side, "Size Y": side, "Vertices X": 2, "Vertices Y": 2}
    square = _linked(tree, "GeometryNodeMeshGrid", sizes).outputs["Mesh"]
    place = tree.nodes.new("GeometryNodeInputPosition").outputs[0]
    stored = {"Geometry": square, "Name": OFFSET, "Value": place}
    square = _linked(tree, "GeometryNodeStoreNamedAttribute", stored, data_type="FLOAT_VECTOR").outputs[0]
    centered = {"Geometry": given, "Name": CENTER, "Value": place}
    given = _linked(tree, "GeometryNodeStoreNamedAttribute", centered, data_type="FLOAT_VECTOR").outputs[0]
    rotation, scale = named("rotation", "QUATERNION"), named("scale", "FLOAT_VECTOR")
    each = {"Points": given, "Instance": square, "Rotation": rotation, "Scale": scale}
    placed = _linked(tree, "GeometryNodeInstanceOnPoints", each).outputs[0]
    real = _linked(tree, "GeometryNodeRealizeInstances", {"Geometry": placed}).outputs[0]
    dressed = _linked(tree, "GeometryNodeSetMaterial", {"Geometry": real, "Material": material}).outputs[0]
    _linked(tree, "NodeGroupOutput", {0: dressed})
    return tree


def disc_material() -> bpy.types.Material:
    """Return the material: a dielectric with the colour, roughness and normal of each Gaussian, faded to its edge."""
    material = bpy.data.materials.new("Relightable Gaussians")
    if material.node_tree is None:  # from Blender 5 on, there is always one
        material.use_nodes = True
    material.surface_render_method = "DITHERED"
    material.cycles.use_bump_map_correction = False  # normals are of the surface, not of its bumps
    tree = material.node_tree
    tree.nodes.clear()

    def attribute(name: str, output: str) -> bpy.types.NodeSocket:
        return _linked(tree, "ShaderNodeAttribute", {}, attribute_name=name).outputs[output]

    def math(operation: str, *values: object) -> bpy.types.NodeSocket:
        return _linked(tree, "ShaderNodeMath", dict(enumerate(values)), operation=operation).outputs[0]

    def vector(operation: str, output: str, **inputs: object) -> bpy.types.NodeSocket:
        numbered = {int(name[1:]): value for name, value in inputs.items()}
        return _linked(tree, "ShaderNodeVectorMath", numbered, operation=operation).outputs[output]

    def changed(kind: str, first: str, last: str, value: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
        way = {"vector_type": kind, "convert_from": first, "convert_to": last}
        return _linked(tree, "ShaderNodeVectorTransform", {"Vector": value}, **way).outputs[0]

    offset = attribute(OFFSET, "Vector")
    square = vector("DOT_PRODUCT", "Value", v0=offset, v1=offset)
    alpha = math("MULTIPLY", attribute("opacity", "Fac"), math("EXPONENT", math("MULTIPLY", square, -0.5)))
    alpha = math("MINIMUM", math("MULTIPLY", alpha, math("GREATER_THAN", alpha, ALPHA_MIN)), ALPHA_MAX)

    geometry, path = tree.nodes.new("ShaderNodeNewGeometry"), tree.nodes.new("ShaderNodeLightPath")
    towards = geometry.outputs["Incoming"]
    normal = changed("NORMAL", "OBJECT", "WORLD", attribute("shading_normal", "Vector"))
    back = vector("SCALE", "Vector", v0=towards, v3=path.outputs["Ray Length"])
    start = vector("ADD", "Vector", v0=geometry.outputs["Position"], v1=back)
    start, center = changed("POINT", "WORLD", "OBJECT", start), attribute(CENTER, "Vector")
    size = _linked(tree, "ShaderNodeSeparateXYZ", {0: attribute("scale", "Vector")})
    size = math("MAXIMUM", size.outputs["X"], size.outputs["Y"])
    far = math("GREATER_THAN", vector("DISTANCE", "Value", v0=start, v1=center), math("MULTIPLY", size, LAYER))
    cosine = vector("DOT_PRODUCT", "Value", v0=towards, v1=normal)
    from_front = math("GREATER_THAN", cosine, 0.0)
    meets = math("MAXIMUM", math("MAXIMUM", far, from_front), path.outputs["Is Camera Ray"])
    alpha = math("MULTIPLY", alpha, meets)

    away = math("LESS_THAN", cosine, -0.2)
    facing = _linked(tree, "ShaderNodeMath", {0: away, 1: -2.0, 2: 1.0}, operation="MULTIPLY_ADD").outputs[0]
    normal = vector("SCALE", "Vector", v0=normal, v3=facing)
    principled = _linked(
        tree,
        "ShaderNodeBsdfPrincipled",
        {
            "Base Color": attribute("base_color", "Color"),
            "Roughness": attribute("roughness", "Fac"),
            "IOR": 1.5,  # reflects 4 % at normal incidence
            "Alpha": alpha,
            "Normal": normal,
        },
        distribution="GGX",
    )
    _linked(tree, "ShaderNodeOutputMaterial", {"Surface": principled.outputs[0]})
    return material
