"""Compiled shading of rasterized surfaces: textures, lamps and shadows.

The reflection is that of VTK's physically based shading of surfaces that are not metallic: Lambert
and GGX with Schlick's Fresnel term and Smith's height-correlated visibility (Karis 2013; Lagarde
and de Rousiers 2014, Sec. 3.1), encoded with a gamma of 2.2.

C is the frame of the camera: z along the optical axis, x to the right of the image, y down. L is
the view frame of a lamp.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_clutter.compilation import njit

GAMMA = 2.2
"""Exponent of the encoding of colors (VTK's)."""
_LEVELS = 65535
_F0 = np.float32(0.04)
"""Reflectance at normal incidence, of a refractive index of 1.5 (VTK's default)."""
_PI = np.float32(np.pi)
_ONE = np.float32(1.0)
_ZERO = np.float32(0.0)
_HALF = np.float32(0.5)
_TINY = np.float32(1e-5)
"""Least cosine of an angle (VTK's)."""
SHADOW_OFFSET = 1.5
"""Distance from a surface at which its shadow is looked up, in pixels of the shadow map.

It exceeds the square root of 2, the reach of the interpolation, within which a tilted surface would
shadow itself.
"""

# Shading works on blocks of pixels. Each quantity has its place in one buffer, at a constant
# distance from the others, so that the compiler can vectorize the loops.
_BLOCK = 64
_NX, _NY, _NZ = 0 * _BLOCK, 1 * _BLOCK, 2 * _BLOCK
_VX, _VY, _VZ = 3 * _BLOCK, 4 * _BLOCK, 5 * _BLOCK
_Z, _NDV, _A2 = 6 * _BLOCK, 7 * _BLOCK, 8 * _BLOCK
_AR, _AG, _AB = 9 * _BLOCK, 10 * _BLOCK, 11 * _BLOCK
_LX, _LY, _LZ, _E = 12 * _BLOCK, 13 * _BLOCK, 14 * _BLOCK, 15 * _BLOCK
_R, _G, _B = 16 * _BLOCK, 17 * _BLOCK, 18 * _BLOCK
_COLUMN = 19 * _BLOCK
_BUFFER = 20 * _BLOCK


class LampArrays(NamedTuple):
    """Lamps in the frame of the camera.

    Attributes:
        vector: Unit vector towards a directional lamp, or position of a point lamp [m]. Shape
            (n, 3), float32.
        color: Product of intensity, color and exposure. Shape (n, 3), float32.
        is_point: Whether the lamp is a point. Shape (n,).
        shadow_map: Index of the lamp's shadow map; -1 if it casts no shadows. Shape (n,).
        maps: Nearness of what each of s lamps sees. Shape (s, size, size), float32.
        X_LC: Pose of the camera in the view frame of such a lamp [m]. Shape (s, 3, 4), float32.
        projection: `View` of such a lamp as scale, u0, v0 and whether it is perspective. Shape
            (s, 4), float32.
    """

    vector: NDArray[np.float32]
    color: NDArray[np.float32]
    is_point: NDArray[np.bool_]
    shadow_map: NDArray[np.int64]
    maps: NDArray[np.float32]
    X_LC: NDArray[np.float32]
    projection: NDArray[np.float32]


def make_decoding_table() -> NDArray[np.float32]:
    """Return the linear values of sRGB values (IEC 61966-2-1). Shape (256,)."""
    value = np.arange(256) / 255
    low = value / 12.92
    return np.where(value <= 0.04045, low, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def make_encoding_table() -> NDArray[np.uint8]:
    """Return the 8-bit values of linear values in equal steps from 0 to 1. Shape (65536,)."""
    linear = np.arange(_LEVELS + 1) / _LEVELS
    return np.rint(255 * linear ** (1 / GAMMA)).astype(np.uint8)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _wrap(index, size, repeats):  # type: ignore[no-untyped-def]
    """Return an index within a texture."""
    if repeats:
        return index % size
    return min(max(index, 0), size - 1)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _decode(texel, decode):  # type: ignore[no-untyped-def]
    """Return the linear color of a pixel of a texture, see `MeshArrays.texels`."""
    return (
        decode[texel & np.uint32(255)],
        decode[(texel >> np.uint32(8)) & np.uint32(255)],
        decode[(texel >> np.uint32(16)) & np.uint32(255)],
    )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _sample_texture(texels, first, width, height, repeats, decode, s, t):  # type: ignore[no-untyped-def]
    """Return the linear color at a position (s, t) [px], interpolated between four pixels.

    Args:
        texels: Pixels of all textures. Shape (n,).
        first: Start of the texture in it.
        width: Width of the texture [px].
        height: Height of the texture [px].
        repeats: Whether the texture repeats beyond its edges.
        decode: Linear values of sRGB values. Shape (256,).
        s: Column.
        t: Row.
    """
    if width == 1 and height == 1:
        return _decode(texels[first], decode)
    left, top = np.floor(s), np.floor(t)
    fs, ft = np.float32(s - left), np.float32(t - top)
    column, row = np.int64(left), np.int64(top)
    c0, c1 = _wrap(column, width, repeats), _wrap(column + 1, width, repeats)
    r0 = first + _wrap(row, height, repeats) * width
    r1 = first + _wrap(row + 1, height, repeats) * width
    w00, w01 = (_ONE - fs) * (_ONE - ft), fs * (_ONE - ft)
    w10, w11 = (_ONE - fs) * ft, fs * ft
    # Unsigned indices need no check for negative values.
    red00, green00, blue00 = _decode(texels[np.uint64(r0 + c0)], decode)
    red01, green01, blue01 = _decode(texels[np.uint64(r0 + c1)], decode)
    red10, green10, blue10 = _decode(texels[np.uint64(r1 + c0)], decode)
    red11, green11, blue11 = _decode(texels[np.uint64(r1 + c1)], decode)
    return (
        w00 * red00 + w01 * red01 + w10 * red10 + w11 * red11,
        w00 * green00 + w01 * green01 + w10 * green10 + w11 * green11,
        w00 * blue00 + w01 * blue01 + w10 * blue10 + w11 * blue11,
    )


# In the loops over pixels, arrays are indexed directly: numba counts references of slices.


@njit(cache=True, nogil=True, error_model="numpy")
def _add_shadows(buffer, count, shadow, X_LC, projection):  # type: ignore[no-untyped-def]
    """Multiply the irradiance by the fraction of a lamp's light that reaches each pixel.

    Args:
        buffer: The buffer.
        count: Number of pixels in it.
        shadow: Nearness of what the lamp sees. Shape (size, size).
        X_LC: Pose of the camera in the view frame of the lamp [m]. Shape (3, 4).
        projection: Scale, u0, v0 and whether the view is perspective. Shape (4,).
    """
    r00, r01, r02, p0 = X_LC[0, 0], X_LC[0, 1], X_LC[0, 2], X_LC[0, 3]
    r10, r11, r12, p1 = X_LC[1, 0], X_LC[1, 1], X_LC[1, 2], X_LC[1, 3]
    r20, r21, r22, p2 = X_LC[2, 0], X_LC[2, 1], X_LC[2, 2], X_LC[2, 3]
    scale, u0, v0 = projection[0], projection[1], projection[2]
    is_perspective = projection[3] != _ZERO
    last = shadow.shape[0] - 1
    end = np.float32(last)
    for i in range(count):
        nx, ny, nz = buffer[_NX + i], buffer[_NY + i], buffer[_NZ + i]
        if nx * buffer[_LX + i] + ny * buffer[_LY + i] + nz * buffer[_LZ + i] <= _ZERO:
            continue
        # The direction of the camera has z = -1 / length.
        distance = buffer[_Z + i] / buffer[_VZ + i]
        x, y, z = distance * buffer[_VX + i], distance * buffer[_VY + i], buffer[_Z + i]
        offset = np.float32(SHADOW_OFFSET) / scale
        if is_perspective:
            offset = offset * max(r20 * x + r21 * y + r22 * z + p2, _ZERO)
        x, y, z = x + offset * nx, y + offset * ny, z + offset * nz
        px = r00 * x + r01 * y + r02 * z + p0
        py = r10 * x + r11 * y + r12 * z + p1
        depth = r20 * x + r21 * y + r22 * z + p2
        size, nearness = scale, -depth
        if is_perspective:
            if depth <= _ZERO:
                continue
            nearness = _ONE / depth
            size = scale / depth
        u, v = u0 + size * px, v0 + size * py
        if not (u >= _ZERO and v >= _ZERO and u < end and v < end):
            continue
        column, row = np.int64(u), np.int64(v)
        fu, fv = u - np.float32(column), v - np.float32(row)
        lit = _ZERO
        if shadow[row, column] <= nearness:
            lit += (_ONE - fu) * (_ONE - fv)
        if shadow[row, column + 1] <= nearness:
            lit += fu * (_ONE - fv)
        if shadow[row + 1, column] <= nearness:
            lit += (_ONE - fu) * fv
        if shadow[row + 1, column + 1] <= nearness:
            lit += fu * fv
        buffer[_E + i] *= lit


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(buffer, count, row, meshes, mesh_ids, hit, surfaces, owner, decode, view):  # type: ignore[no-untyped-def]
    """Fill the buffer with normal, direction of the camera, depth and material of each pixel."""
    texels, texture, color = meshes.texels, meshes.texture, meshes.color
    roughnesses = meshes.roughness
    scale, u0, v0 = np.float32(view.scale), np.float32(view.u0), np.float32(view.v0)
    v = np.float32(row)
    for i in range(count):
        u = buffer[_COLUMN + i]
        k = np.uint64(hit[row, np.uint64(u)])
        du, dv = u - surfaces[k, 0], v - surfaces[k, 1]
        z = _ONE / (surfaces[k, 2] * du + surfaces[k, 3] * dv + surfaces[k, 4])
        buffer[_Z + i] = z
        buffer[_VX + i] = (u0 - u) / scale
        buffer[_VY + i] = (v0 - v) / scale
        buffer[_NX + i] = surfaces[k, 5] * du + surfaces[k, 6] * dv + surfaces[k, 7]
        buffer[_NY + i] = surfaces[k, 8] * du + surfaces[k, 9] * dv + surfaces[k, 10]
        buffer[_NZ + i] = surfaces[k, 11] * du + surfaces[k, 12] * dv + surfaces[k, 13]
        s = (surfaces[k, 14] * du + surfaces[k, 15] * dv + surfaces[k, 16]) * z
        t = (surfaces[k, 17] * du + surfaces[k, 18] * dv + surfaces[k, 19]) * z
        mesh = mesh_ids[owner[k]]
        red, green, blue = _sample_texture(
            texels,
            texture[mesh, 0],
            texture[mesh, 1],
            texture[mesh, 2],
            texture[mesh, 3] != 0,
            decode,
            s,
            t,
        )
        buffer[_AR + i] = red * color[mesh, 0]
        buffer[_AG + i] = green * color[mesh, 1]
        buffer[_AB + i] = blue * color[mesh, 2]
        roughness = roughnesses[mesh]
        buffer[_A2 + i] = roughness * roughness * roughness * roughness


@njit(cache=True, nogil=True, error_model="numpy")
def _prepare(buffer, ambient):  # type: ignore[no-untyped-def]
    """Normalize normal and direction of the camera, and start with the ambient light."""
    for i in range(_BLOCK):
        vx, vy = buffer[_VX + i], buffer[_VY + i]
        length = np.sqrt(vx * vx + vy * vy + _ONE)
        vx, vy, vz = vx / length, vy / length, -_ONE / length
        nx, ny, nz = buffer[_NX + i], buffer[_NY + i], buffer[_NZ + i]
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        ndv = nx * vx + ny * vy + nz * vz
        # What is seen of a surface is its front.
        length = length if ndv >= _ZERO else -length
        buffer[_NX + i] = nx / length
        buffer[_NY + i] = ny / length
        buffer[_NZ + i] = nz / length
        buffer[_VX + i] = vx
        buffer[_VY + i] = vy
        buffer[_VZ + i] = vz
        ndv = ndv / length
        buffer[_NDV + i] = ndv if ndv > _TINY else _TINY
        buffer[_R + i] = ambient * buffer[_AR + i]
        buffer[_G + i] = ambient * buffer[_AG + i]
        buffer[_B + i] = ambient * buffer[_AB + i]


@njit(cache=True, nogil=True, error_model="numpy")
def _aim_lamp(buffer, x, y, z, is_point):  # type: ignore[no-untyped-def]
    """Fill the buffer with the direction of a lamp, and its irradiance relative to that at 1 m."""
    if not is_point:
        for i in range(_BLOCK):
            buffer[_LX + i] = x
            buffer[_LY + i] = y
            buffer[_LZ + i] = z
            buffer[_E + i] = _ONE
        return
    for i in range(_BLOCK):
        # The direction of the camera has z = -1 / length.
        depth = -buffer[_Z + i] / buffer[_VZ + i]
        lx = x + depth * buffer[_VX + i]
        ly = y + depth * buffer[_VY + i]
        lz = z + depth * buffer[_VZ + i]
        square = lx * lx + ly * ly + lz * lz
        length = np.sqrt(square)
        buffer[_LX + i] = lx / length
        buffer[_LY + i] = ly / length
        buffer[_LZ + i] = lz / length
        buffer[_E + i] = _ONE / square


@njit(cache=True, nogil=True, error_model="numpy")
def _add_lamp(buffer, red, green, blue):  # type: ignore[no-untyped-def]
    """Add the light of a lamp that surfaces reflect to the camera."""
    for i in range(_BLOCK):
        lx, ly, lz = buffer[_LX + i], buffer[_LY + i], buffer[_LZ + i]
        nx, ny, nz = buffer[_NX + i], buffer[_NY + i], buffer[_NZ + i]
        vx, vy, vz = buffer[_VX + i], buffer[_VY + i], buffer[_VZ + i]
        ndv, a2 = buffer[_NDV + i], buffer[_A2 + i]
        hx, hy, hz = vx + lx, vy + ly, vz + lz
        length = np.sqrt(hx * hx + hy * hy + hz * hz)
        length = length if length > _TINY else _TINY
        hdv = (hx * vx + hy * vy + hz * vz) / length
        ndh = (nx * hx + ny * hy + nz * hz) / length
        ndl = nx * lx + ny * ly + nz * lz
        hdv = hdv if hdv > _TINY else _TINY
        hdv = hdv if hdv < _ONE else _ONE
        ndh = ndh if ndh > _TINY else _TINY
        ndh = ndh if ndh < _ONE else _ONE
        ndl = ndl if ndl > _TINY else _TINY
        ndl = ndl if ndl < _ONE else _ONE
        d = (ndh * a2 - ndh) * ndh + _ONE
        visible_v = ndl * np.sqrt(a2 + ndv * (ndv - a2 * ndv))
        visible_l = ndv * np.sqrt(a2 + ndl * (ndl - a2 * ndl))
        grazing = _ONE - hdv
        fresnel = _F0 + (_ONE - _F0) * grazing * grazing * grazing * grazing * grazing
        specular = a2 / (_PI * d * d) * (_HALF / (visible_v + visible_l)) * fresnel
        diffuse = (_ONE - fresnel) / _PI
        light = ndl * buffer[_E + i]
        buffer[_R + i] += red * light * (specular + diffuse * buffer[_AR + i])
        buffer[_G + i] += green * light * (specular + diffuse * buffer[_AG + i])
        buffer[_B + i] += blue * light * (specular + diffuse * buffer[_AB + i])


@njit(cache=True, nogil=True, error_model="numpy")
def _shade_block(buffer, count, lamps, ambient):  # type: ignore[no-untyped-def]
    """Light the pixels of the buffer."""
    _prepare(buffer, ambient)
    for lamp in range(len(lamps.color)):
        x, y, z = lamps.vector[lamp, 0], lamps.vector[lamp, 1], lamps.vector[lamp, 2]
        _aim_lamp(buffer, x, y, z, lamps.is_point[lamp])
        k = lamps.shadow_map[lamp]
        if k >= 0:
            _add_shadows(buffer, count, lamps.maps[k], lamps.X_LC[k], lamps.projection[k])
        _add_lamp(buffer, lamps.color[lamp, 0], lamps.color[lamp, 1], lamps.color[lamp, 2])


@njit(cache=True, nogil=True, error_model="numpy")
def shade(meshes, mesh_ids, view, hit, surfaces, owner, lamps, ambient, tables, background, color):  # type: ignore[no-untyped-def]
    """Write the colors of what was drawn.

    Args:
        meshes: `MeshArrays`.
        mesh_ids: Mesh of each instance. Shape (n,).
        view: `View` of the camera.
        hit: Triangle in each pixel, -1 where there is none, from `draw`. Shape (height, width).
        surfaces: Triangles, from `draw`. Shape (t, 20).
        owner: Instance of each triangle, from `draw`. Shape (t,).
        lamps: `LampArrays`.
        ambient: Radiance of a white surface without lamps, times the exposure.
        tables: Tables of `make_decoding_table` and `make_encoding_table`.
        background: Color where there is no triangle. Shape (3,).
        color: Output. Shape (height, width, 3).
    """
    decode, encode = tables
    buffer = np.ones(_BUFFER, np.float32)
    height, width = hit.shape
    full = np.float32(_LEVELS)
    red, green, blue = background
    for row in range(height):
        count = 0
        for column in range(width):
            if hit[row, column] >= 0:
                buffer[_COLUMN + count] = np.float32(column)
                count += 1
            else:
                color[row, column, 0] = red
                color[row, column, 1] = green
                color[row, column, 2] = blue
            if count == _BLOCK or (count and column == width - 1):
                _gather(buffer, count, row, meshes, mesh_ids, hit, surfaces, owner, decode, view)
                _shade_block(buffer, count, lamps, np.float32(ambient))
                for i in range(count):
                    k = np.int64(buffer[_COLUMN + i])
                    color[row, k, 0] = encode[np.int64(min(buffer[_R + i], _ONE) * full + _HALF)]
                    color[row, k, 1] = encode[np.int64(min(buffer[_G + i], _ONE) * full + _HALF)]
                    color[row, k, 2] = encode[np.int64(min(buffer[_B + i], _ONE) * full + _HALF)]
                count = 0
