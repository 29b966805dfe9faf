/** The page: navigation, and one view for each part of it, made when it is first turned to. */

import { Api } from './api'
import { h, replace } from './dom'
import { DrawView } from './draw/view'
import { ExploreView } from './explore/view'
import { askForKey } from './key'
import { ReconstructView } from './reconstruct/view'
import { type Route, currentRoute } from './route'
import { T } from './text'
import { startTheme, themeChoice } from './theme'

const VIEWS = ['reconstruct', 'draw', 'explore'] as const

class Page {
  private readonly main = h('main', { id: 'main' })
  private readonly links = VIEWS.map((name) => h('a', { href: `#/${name === 'reconstruct' ? '' : name}` }, T.views[name]))
  private reconstruct: ReconstructView | null = null
  private draw: DrawView | null = null
  private explore: ExploreView | null = null
  private readonly api = new Api(askForKey)

  start(root: HTMLElement): void {
    const header = h(
      'header',
      { class: 'top' },
      h('a', { class: 'skip', href: '#main', onclick: (event: Event) => this.skip(event) }, T.skip),
      h('span', { class: 'name' }, T.name),
      h('nav', { 'aria-label': T.parts }, ...this.links),
      h('div', { class: 'end' }, h('a', { href: 'docs' }, T.interface), themeChoice()),
    )
    replace(root, header, this.main)
    startTheme()
    window.addEventListener('hashchange', () => this.turn())
    this.turn()
  }

  private turn(): void {
    const route = currentRoute()
    VIEWS.forEach((name, n) => {
      if (name === route.view) this.links[n]!.setAttribute('aria-current', 'page')
      else this.links[n]!.removeAttribute('aria-current')
    })
    this.open(route)
  }

  private open(route: Route): void {
    if (route.view === 'draw') {
      this.show((this.draw ??= started(new DrawView(this.api))).element)
    } else if (route.view === 'explore') {
      this.show((this.explore ??= started(new ExploreView(this.api, route.query))).element)
      this.explore.refresh(route.query)
    } else {
      this.show((this.reconstruct ??= started(new ReconstructView(this.api))).element)
      if (route.result) void this.reconstruct.open(route.result)
      else this.reconstruct.refresh()
    }
  }

  /** Views stay in the page, hidden, so that nothing drawn is lost. */
  private show(element: HTMLElement): void {
    if (!element.isConnected) this.main.append(element)
    for (const child of this.main.children) (child as HTMLElement).hidden = child !== element
  }

  private skip(event: Event): void {
    event.preventDefault()
    this.main.tabIndex = -1
    this.main.focus()
  }
}

function started<V extends { start(): Promise<void> }>(view: V): V {
  void view.start()
  return view
}

new Page().start(document.getElementById('app')!)
