/** The service, by addresses relative to the page. */

import { saveAs } from './dom'
import type { DrawnPlanes, Mode, ModelDescription, ModelSummary, Plane, Problem, Summary } from './types'
import { T } from './text'

const KEY = 'morphoflow-key'

/** What went wrong, in the service's own sentence. */
export class Refusal extends Error {
  constructor(
    message: string,
    readonly status: number,
  ) {
    super(message)
  }

  /** Whether the same may succeed later: nobody answered, or the service could not. */
  get isPassing(): boolean {
    return this.status === 0 || this.status >= 500
  }
}

export type AskForKey = (wrong: boolean) => Promise<string>

export class Api {
  private asked: Promise<void> | null = null

  constructor(private readonly askForKey: AskForKey) {}

  /** An answer, after asking for a key where the service wants one. */
  async fetch(path: string, init: RequestInit = {}): Promise<Response> {
    for (;;) {
      const key = sessionStorage.getItem(KEY)
      const headers = new Headers(init.headers)
      if (key) headers.set('X-API-Key', key)
      const answer = await fetch(path, { ...init, headers }).catch((fault: unknown) => {
        throw isAbort(fault) ? fault : new Refusal(T.unreachable, 0)
      })
      if (answer.status === 401) await this.renewKey(key)
      else if (answer.ok) return answer
      else throw await refusal(answer)
    }
  }

  async json<V>(path: string, init: RequestInit = {}): Promise<V> {
    return (await (await this.fetch(path, init)).json()) as V
  }

  async bytes(path: string, signal?: AbortSignal): Promise<ArrayBuffer> {
    return (await this.fetch(path, signal ? { signal } : {})).arrayBuffer()
  }

  async models(): Promise<ModelSummary[]> {
    return (await this.json<{ models: ModelSummary[] }>('v1/models')).models
  }

  model(name: string, signal: AbortSignal): Promise<ModelDescription> {
    return this.json(`v1/models/${encodeURIComponent(name)}`, { signal })
  }

  async modes(model: string, signal: AbortSignal): Promise<Mode[]> {
    return (await this.json<{ modes: Mode[] }>(`v1/models/${encodeURIComponent(model)}/modes`, { signal })).modes
  }

  planes(body: FormData, signal: AbortSignal): Promise<DrawnPlanes> {
    return this.json('v1/planes', { method: 'POST', body, signal })
  }

  reconstruct(body: FormData, signal: AbortSignal): Promise<Summary> {
    return this.json('v1/reconstructions', { method: 'POST', body, signal })
  }

  summary(id: string, signal: AbortSignal): Promise<Summary> {
    return this.json(resultPath(id), { signal })
  }

  async forget(id: string): Promise<void> {
    await this.fetch(resultPath(id), { method: 'DELETE', keepalive: true })
  }

  /** Save an answer as a file; a plain link could not send the key. */
  async download(path: string, name: string): Promise<void> {
    saveAs(await (await this.fetch(path)).blob(), name)
  }

  private renewKey(used: string | null): Promise<void> {
    if (used !== sessionStorage.getItem(KEY)) return Promise.resolve()
    this.asked ??= this.askForKey(used !== null)
      .then((key) => sessionStorage.setItem(KEY, key))
      .finally(() => (this.asked = null))
    return this.asked
  }
}

export function resultPath(id: string, part = ''): string {
  return `v1/reconstructions/${encodeURIComponent(id)}${part}`
}

export function isAbort(fault: unknown): boolean {
  return fault instanceof DOMException && fault.name === 'AbortError'
}

export function sentence(fault: unknown): string {
  return fault instanceof Error ? fault.message : String(fault)
}

/** The form of a request; empty choices are left to the service. */
export function formOf(masks: File[], choices: Record<string, string>, planes?: Plane[]): FormData {
  const form = new FormData()
  for (const mask of masks) form.append('mask', mask, mask.name)
  for (const [name, value] of Object.entries(choices)) if (value !== '') form.append(name, value)
  if (planes) form.set('annotated', JSON.stringify(planes))
  return form
}

async function refusal(answer: Response): Promise<Refusal> {
  const problem = (await answer.json().catch(() => null)) as Problem | null
  return new Refusal(problem?.detail ?? T.failed(answer.status), answer.status)
}
