/** Pixels of a plane's picture inside a contour or under a brush. */

export type Point = [number, number]

/** Pixels whose centres lie inside a closed contour (even-odd rule). */
export function insideContour(contour: Point[], width: number, height: number): Point[] {
  const found: Point[] = []
  const rows = contour.map((point) => point[1])
  const first = Math.max(Math.floor(Math.min(...rows)), 0)
  const last = Math.min(Math.ceil(Math.max(...rows)), height - 1)
  for (let y = first; y <= last; y += 1) {
    const crossings = crossingsAt(contour, y + 0.5)
    for (let n = 0; n + 1 < crossings.length; n += 2) {
      const from = Math.max(Math.ceil(crossings[n]! - 0.5), 0)
      const to = Math.min(Math.ceil(crossings[n + 1]! - 0.5), width)
      for (let x = from; x < to; x += 1) found.push([x, y])
    }
  }
  return found
}

/** Pixels within a radius (mm) of a line from one point to another. */
export function underBrush(from: Point, to: Point, radius: number, spacing: Point, width: number, height: number): Point[] {
  const found: Point[] = []
  const [rx, ry] = [radius / spacing[0], radius / spacing[1]]
  const range = (a: number, b: number, r: number, size: number): [number, number] => [
    Math.max(Math.floor(Math.min(a, b) - r), 0),
    Math.min(Math.ceil(Math.max(a, b) + r), size - 1),
  ]
  const [left, right] = range(from[0], to[0], rx, width)
  const [top, bottom] = range(from[1], to[1], ry, height)
  for (let y = top; y <= bottom; y += 1) {
    for (let x = left; x <= right; x += 1) {
      if (distance([x + 0.5, y + 0.5], from, to, spacing) <= radius) found.push([x, y])
    }
  }
  return found
}

function crossingsAt(contour: Point[], y: number): number[] {
  const found: number[] = []
  contour.forEach(([x0, y0], n) => {
    const [x1, y1] = contour[(n + 1) % contour.length]!
    if (y0 <= y !== y1 <= y) found.push(x0 + ((y - y0) / (y1 - y0)) * (x1 - x0))
  })
  return found.sort((a, b) => a - b)
}

function distance(point: Point, from: Point, to: Point, spacing: Point): number {
  const along: Point = [(to[0] - from[0]) * spacing[0], (to[1] - from[1]) * spacing[1]]
  const away: Point = [(point[0] - from[0]) * spacing[0], (point[1] - from[1]) * spacing[1]]
  const length = along[0] ** 2 + along[1] ** 2
  const share = length ? Math.min(Math.max((away[0] * along[0] + away[1] * along[1]) / length, 0), 1) : 0
  return Math.hypot(away[0] - share * along[0], away[1] - share * along[1])
}
