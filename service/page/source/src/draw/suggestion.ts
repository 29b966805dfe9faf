/** The plane whose drawing would tell most. */

import { type Api, resultPath } from '../api'
import type { Plane } from '../types'

export interface Suggestion {
  plane: Plane
  /** Share of the surface's standard deviation that drawing it is expected to take away. */
  gain: number
}

interface Answer {
  plane: Plane | null
  surface_sd_mm: { now: number; expected: number }
}

export async function nextPlane(api: Api, id: string, signal: AbortSignal): Promise<Suggestion | null> {
  const { plane, surface_sd_mm: sd } = await api.json<Answer>(resultPath(id, '/next-plane'), { signal })
  return plane && { plane, gain: sd.now > 0 ? 1 - sd.expected / sd.now : 0 }
}
