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


@njit(cache=True, nogil=True, error_model="numpy")
def _sample_texture(texels, texture, decode, s, t):  # type: ignore[no-untyped-def]
    """Return the linear color at a position (s, t) [px], interpolated between four pixels."""
    first, width, height, repeats = texture[0], texture[1], texture[2], texture[3] != 0
    if width == 1 and height == 1:
        return decode[texels[first]], decode[texels[first + 1]], decode[texels[first + 2]]
    left, top = np.floor(s), np.floor(t)
    fs, ft = np.float32(s - left), np.float32(t - top)
    column, row = np.int64(left), np.int64(top)
    c0, c1 = _wrap(column, width, repeats), _wrap(column + 1, width, repeats)
    r0, r1 = _wrap(row, height, repeats), _wrap(row + 1, height, repeats)
    i00, i01 = first + 3 * (r0 * width + c0), first + 3 * (r0 * width + c1)
    i10, i11 = first + 3 * (r1 * width + c0), first + 3 * (r1 * width + c1)
    w00, w01 = (_ONE - fs) * (_ONE - ft), fs * (_ONE - ft)
    w10, w11 = (_ONE - fs) * ft, fs * ft
    red = (
        w00 * decode[texels[i00]]
        + w01 * decode[texels[i01]]
        + w10 * decode[texels[i10]]
        + w11 * decode[texels[i11]]
    )
    green = (
        w00 * decode[texels[i00 + 1]]
        + w01 * decode[texels[i01 + 1]]
        + w10 * decode[texels[i10 + 1]]
        + w11 * decode[texels[i11 + 1]]
    )
    blue = (
        w00 * decode[texels[i00 + 2]]
        + w01 * decode[texels[i01 + 2]]
        + w10 * decode[texels[i10 + 2]]
        + w11 * decode[texels[i11 + 2]]
    )
    return red, green, blue


@njit(cache=True, nogil=True, error_model="numpy")
def _lit_fraction(shadow, X, view, x, y, z, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Return the fraction of a lamp's light that reaches a point, from its shadow map.

    Args:
        shadow: The shadow map. Shape (size, size).
        X: Pose X_LC. Shape (3, 4).
        view: Scale, u0, v0 and whether the view is perspective. Shape (4,).
        x: Point in C [m].
        y: Point in C [m].
        z: Point in C [m].
        nx: Unit normal in C.
        ny: Unit normal in C.
        nz: Unit normal in C.
    """
    scale = view[0]
    is_perspective = view[3] != _ZERO
    depth = X[2, 0] * x + X[2, 1] * y + X[2, 2] * z + X[2, 3]
    offset = np.float32(SHADOW_OFFSET) / scale
    if is_perspective:
        if depth <= _ZERO:
            return _ONE
        offset = offset * depth
    x, y, z = x + offset * nx, y + offset * ny, z + offset * nz
    p_x = X[0, 0] * x + X[0, 1] * y + X[0, 2] * z + X[0, 3]
    p_y = X[1, 0] * x + X[1, 1] * y + X[1, 2] * z + X[1, 3]
    depth = X[2, 0] * x + X[2, 1] * y + X[2, 2] * z + X[2, 3]
    nearness = -depth
    if is_perspective:
        if depth <= _ZERO:
            return _ONE
        nearness = _ONE / depth
        scale = scale / depth
    u, v = view[1] + scale * p_x, view[2] + scale * p_y
    size = shadow.shape[0]
    if not (u >= _ZERO and v >= _ZERO and u < np.float32(size - 1) and v < np.float32(size - 1)):
        return _ONE
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
    return lit


@njit(cache=True, nogil=True, error_model="numpy")
def _gather(buffer, count, row, meshes, mesh_ids, hit, surfaces, owner, decode, view):  # type: ignore[no-untyped-def]
    """Fill the buffer with normal, direction of the camera, depth and material of each pixel."""
    v = np.float32(row)
    for i in range(count):
        u = np.float32(buffer[_COLUMN + i])
        triangle = hit[row, np.int64(buffer[_COLUMN + i])]
        a = surfaces[triangle]
        du, dv = u - a[0], v - a[1]
        z = _ONE / (a[2] * du + a[3] * dv + a[4])
        buffer[_Z + i] = z
        buffer[_VX + i] = (np.float32(view.u0) - u) / np.float32(view.scale)
        buffer[_VY + i] = (np.float32(view.v0) - v) / np.float32(view.scale)
        buffer[_NX + i] = a[5] * du + a[6] * dv + a[7]
        buffer[_NY + i] = a[8] * du + a[9] * dv + a[10]
        buffer[_NZ + i] = a[11] * du + a[12] * dv + a[13]
        s, t = (a[14] * du + a[15] * dv + a[16]) * z, (a[17] * du + a[18] * dv + a[19]) * z
        mesh = mesh_ids[owner[triangle]]
        red, green, blue = _sample_texture(meshes.texels, meshes.texture[mesh], decode, s, t)
        buffer[_AR + i] = red * meshes.color[mesh, 0]
        buffer[_AG + i] = green * meshes.color[mesh, 1]
        buffer[_AB + i] = blue * meshes.color[mesh, 2]
        roughness = meshes.roughness[mesh]
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
    for i in range(_BLOCK):
        if is_point:
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
        else:
            buffer[_LX + i] = x
            buffer[_LY + i] = y
            buffer[_LZ + i] = z
            buffer[_E + i] = _ONE


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
            for i in range(count):
                nx, ny, nz = buffer[_NX + i], buffer[_NY + i], buffer[_NZ + i]
                lx, ly, lz = buffer[_LX + i], buffer[_LY + i], buffer[_LZ + i]
                if nx * lx + ny * ly + nz * lz > _ZERO:
                    distance = -buffer[_Z + i] / buffer[_VZ + i]
                    buffer[_E + i] *= _lit_fraction(
                        lamps.maps[k],
                        lamps.X_LC[k],
                        lamps.projection[k],
                        -distance * buffer[_VX + i],
                        -distance * buffer[_VY + i],
                        buffer[_Z + i],
                        nx,
                        ny,
                        nz,
                    )
        _add_lamp(buffer, lamps.color[lamp, 0], lamps.color[lamp, 1], lamps.color[lamp, 2])


@njit(cache=True, nogil=True, error_model="numpy")
def shade(meshes, mesh_ids, view, hit, surfaces, owner, lamps, ambient, tables, color):  # type: ignore[no-untyped-def]
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
        color: Output, to be initialized with the background. Shape (height, width, 3).
    """
    decode, encode = tables
    buffer = np.ones(_BUFFER, np.float32)
    height, width = hit.shape
    full, one = np.float32(_LEVELS), np.float32(1.0)
    for row in range(height):
        count = 0
        for column in range(width):
            if hit[row, column] >= 0:
                buffer[_COLUMN + count] = np.float32(column)
                count += 1
            if count == _BLOCK or (count and column == width - 1):
                _gather(buffer, count, row, meshes, mesh_ids, hit, surfaces, owner, decode, view)
                _shade_block(buffer, count, lamps, np.float32(ambient))
                for i in range(count):
                    here = color[row, np.int64(buffer[_COLUMN + i])]
                    here[0] = encode[np.int64(min(buffer[_R + i], one) * full + _HALF)]
                    here[1] = encode[np.int64(min(buffer[_G + i], one) * full + _HALF)]
                    here[2] = encode[np.int64(min(buffer[_B + i], one) * full + _HALF)]
                count = 0
