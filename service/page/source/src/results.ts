/** Results of this browser window, so that two of them can be compared. */

export interface Known {
  id: string
  label: string
}

const STORED = 'morphoflow-results'
const MOST = 12

export function knownResults(): Known[] {
  try {
    return JSON.parse(sessionStorage.getItem(STORED) ?? '[]') as Known[]
  } catch {
    return []
  }
}

export function remember(result: Known): void {
  const others = knownResults().filter((known) => known.id !== result.id)
  sessionStorage.setItem(STORED, JSON.stringify([result, ...others].slice(0, MOST)))
}

const kept = new Set<string>()

/** A result that somebody opened, copied the link of, or compared is not deleted by the page. */
export function keep(id: string): void {
  kept.add(id)
}

export function isKept(id: string): boolean {
  return kept.has(id)
}

export function dismiss(id: string): void {
  sessionStorage.setItem(STORED, JSON.stringify(knownResults().filter((known) => known.id !== id)))
}
