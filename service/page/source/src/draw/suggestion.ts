/** The plane whose drawing would tell most. */

import { type Api, resultPath } from '../api'
import type { Plane } from '../types'

export interface Suggestion {
  plane: Plane
  /** Share of the present uncertainty that drawing it is expected to take away; null where it is not told. */
  gain: number | null
}

interface Answer {
  plane: Plane | null
  expected_gain?: number
}

export async function nextPlane(api: Api, id: string, signal: AbortSignal): Promise<Suggestion | null> {
  const answer = await api.json<Answer>(resultPath(id, '/next-plane'), { signal })
  return answer.plane && { plane: answer.plane, gain: answer.expected_gain ?? null }
}
