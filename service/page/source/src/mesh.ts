/** Triangle meshes: read from MZ3, cut by a plane, and flat ones of drawn planes. */

import { gunzipSync } from 'fflate'
import type { Vec3 } from './types'

export interface Surface {
  vertices: Float32Array
  faces: Uint32Array
  /** One value for each vertex, where the file holds one. */
  scalars: Float32Array | null
}

const MAGIC = 0x5a4d
const [FACES, VERTICES, COLOURS, SCALARS] = [1, 2, 4, 8]

/** An MZ3 file (little endian: magic, attributes, counts, bytes to skip; then faces, vertices, colours, scalars). */
export function readMz3(buffer: ArrayBuffer): Surface {
  const bytes = new Uint8Array(buffer)
  const data = bytes[0] === 0x1f && bytes[1] === 0x8b ? gunzipSync(bytes) : bytes
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength)
  const attributes = view.getUint16(2, true)
  if (view.getUint16(0, true) !== MAGIC || !(attributes & FACES) || !(attributes & VERTICES)) throw new Error('MZ3')
  const [faceCount, vertexCount] = [view.getUint32(4, true), view.getUint32(8, true)]
  let at = 16 + view.getUint32(12, true)
  const take = (length: number): ArrayBuffer => {
    const part = data.slice(at, at + length).buffer
    at += length
    return part
  }
  const faces = new Uint32Array(take(faceCount * 12))
  const vertices = new Float32Array(take(vertexCount * 12))
  if (attributes & COLOURS) take(vertexCount * 4)
  return { faces, vertices, scalars: attributes & SCALARS ? new Float32Array(take(vertexCount * 4)) : null }
}

export function extents(surface: Surface): [Vec3, Vec3] {
  const low: Vec3 = [Infinity, Infinity, Infinity]
  const high: Vec3 = [-Infinity, -Infinity, -Infinity]
  surface.vertices.forEach((value, place) => {
    const axis = place % 3
    low[axis] = Math.min(low[axis]!, value)
    high[axis] = Math.max(high[axis]!, value)
  })
  return [low, high]
}

/** What lies on the side of a plane that its normal points away from; crossing faces are cut, scalars interpolated. */
export function cut(surface: Surface, normal: Vec3, offset: number): Surface {
  const { vertices, faces, scalars } = surface
  const height = (v: number): number =>
    vertices[3 * v]! * normal[0] + vertices[3 * v + 1]! * normal[1] + vertices[3 * v + 2]! * normal[2] - offset
  const out = new Cutting(surface)
  for (let f = 0; f < faces.length; f += 3) {
    const corners = [faces[f]!, faces[f + 1]!, faces[f + 2]!]
    const heights = corners.map(height)
    out.add(corners, heights)
  }
  return out.surface(scalars !== null)
}

class Cutting {
  private readonly points: number[] = []
  private readonly values: number[] = []
  private readonly faces: number[] = []
  private readonly known = new Map<string, number>()

  constructor(private readonly source: Surface) {}

  add(corners: number[], heights: number[]): void {
    const kept: number[] = []
    for (let n = 0; n < 3; n += 1) {
      const m = (n + 1) % 3
      const [a, b, ha, hb] = [corners[n]!, corners[m]!, heights[n]!, heights[m]!]
      if (ha <= 0) kept.push(this.point(a, a, 0))
      if (ha <= 0 !== hb <= 0) kept.push(a < b ? this.point(a, b, ha / (ha - hb)) : this.point(b, a, hb / (hb - ha)))
    }
    for (let n = 2; n < kept.length; n += 1) this.faces.push(kept[0]!, kept[n - 1]!, kept[n]!)
  }

  surface(scalars: boolean): Surface {
    return {
      vertices: new Float32Array(this.points),
      faces: new Uint32Array(this.faces),
      scalars: scalars ? new Float32Array(this.values) : null,
    }
  }

  /** The vertex at a share of the way from one to another; made once. */
  private point(a: number, b: number, share: number): number {
    const name = `${a}-${b}`
    const found = this.known.get(name)
    if (found !== undefined) return found
    const { vertices, scalars } = this.source
    for (let axis = 0; axis < 3; axis += 1) {
      this.points.push(vertices[3 * a + axis]! * (1 - share) + vertices[3 * b + axis]! * share)
    }
    if (scalars) this.values.push(scalars[a]! * (1 - share) + scalars[b]! * share)
    const number = this.points.length / 3 - 1
    this.known.set(name, number)
    return number
  }
}

/** No surface at all, but a box that keeps the view of different shapes at one scale. */
export function frame(half: Vec3): Surface {
  const [x, y, z] = half
  const vertices = new Float32Array([-x, -y, -z, -x, -y, -z, -x, -y, -z, x, y, z, x, y, z, x, y, z])
  return { vertices, faces: new Uint32Array([0, 1, 2, 3, 4, 5]), scalars: null }
}
