/** All words of the page. */

import type { ModelSummary, Summary } from './types'

const time = (date: Date): string => date.toLocaleTimeString('en-GB', { hour: '2-digit', minute: '2-digit', second: '2-digit' })

export const T = {
  title: 'MorphoFlow: shapes from a few slices',
  name: 'MorphoFlow',
  noScript: 'This page needs JavaScript. The interface without it is described at docs.',
  skip: 'Skip to content',
  parts: 'Parts of the page',
  interface: 'Interface',
  views: { reconstruct: 'Reconstruct', draw: 'Draw', explore: 'Explore' },
  theme: { label: 'Colours of the page', system: 'As the system', light: 'Light', dark: 'Dark' },
  plane: { axial: 'Axial', coronal: 'Coronal', sagittal: 'Sagittal' },
  sliceOf: (plane: string) => `${plane} slice`,
  sliceAt: (slice: number, count: number, mm: number) => `${slice} of ${count} · ${mm.toFixed(1).replace('-', '−')} mm`,
  turnByKeys: '(arrow keys turn it, plus and minus change its size)',
  progress: 'Progress',
  cancel: 'Cancel',
  cancelled: 'Cancelled.',
  seconds: (value: number) => `${value.toFixed(1)} s`,
  mm: (value: number) => `${value.toFixed(1)} mm`,
  percent: (value: number) => `${value.toFixed(0)} %`,
  plainNumber: (value: number) => value.toFixed(1),
  unreachable: 'The service does not answer. Is it running?',
  failed: (status: number) => `The service refused (status ${status}).`,
  notNifti: 'This is not a NIfTI volume of plain numbers; .nii and .nii.gz files are read.',
  brokenNifti: 'This NIfTI file is damaged or ends too early; a whole one is read.',
  madeBy: (model: string, version: string, points: number, iterations: number) =>
    `Made by ${model} ${version} from ${points} points in ${iterations} iterations. Research software, no medical device.`,

  key: {
    title: 'This service asks for a key',
    why: 'The key is kept in this browser tab only, and sent to this service alone.',
    wrong: 'The service does not accept that key. Please try again.',
    label: 'Key',
    use: 'Use this key',
  },

  welcome: {
    title: 'A whole shape from a few slices',
    text: 'Give a mask with some slices drawn, and get a closed surface, a dense segmentation, and a map of how far to trust it.',
    run: 'Show me: reconstruct the example',
    steps: [
      'Drop a mask, or choose its file. Slices without drawing may stay empty.',
      'See which planes the service takes as drawn, and send.',
      'Turn the surface; its colour says how uncertain each place is.',
    ],
    research: 'Everything is computed by this service; nothing leaves it. Research software, no medical device.',
  },

  request: {
    title: 'Reconstruct',
    takeExample: 'Take the example',
    files: 'Chosen masks',
    choose: 'Choose mask files',
    drop: 'Drop masks here, or choose files',
    formats: 'NIfTI, NRRD, MetaImage, DICOM SEG or RTSTRUCT. Several files are several stacks of one object.',
    remove: 'Remove',
    removeFile: (name: string) => `Remove ${name}`,
    model: 'Model',
    modelName: ({ name, version, structure }: ModelSummary) =>
      structure === name ? `${name} ${version}` : `${structure}: ${name} ${version}`,
    uncertainty: 'Uncertainty',
    uncertainties: { laplace: 'Laplace: fast', ensemble: 'Ensemble of 25: slower', none: 'None' },
    more: 'More options',
    annotated: 'Planes that count as looked at',
    annotatedRules: { auto: 'Found from the drawing', nonempty: 'All slices with drawing', all: 'All slices' },
    label: 'Label of the object',
    labelAny: 'any',
    labelHint: 'A number, or several with commas.',
    fidelity: 'Fidelity',
    fidelityHint: '0 trusts the model, 1 trusts the slices.',
    byModel: 'as the model says',
    mirror: 'Left and right',
    mirrors: { never: 'As they are', auto: 'Whichever fits', always: 'Exchanged' },
    resolution: 'Surface grid (mm)',
    seed: 'Seed',
    send: 'Reconstruct',
  },

  steps: {
    reading: 'Reading the masks…',
    fit: 'Fitting the model to the slices',
    fitSlow: 'Fitting 25 models to the slices; this takes a while',
    surface: 'Fetching the surface',
    summary: 'Looking the result up',
  },

  preview: {
    title: 'Annotated planes',
    summary: (count: number, kinds: string, size: string, spacing: number) =>
      `${count} planes count as looked at (${kinds}), on a grid of ${size} voxels, at most ${spacing.toFixed(2)} mm apart.`,
    hint: 'Dashed lines show where other annotated planes cross. Above, the same planes in space.',
    stack: 'Which file is shown',
    ready: (count: number) => `${count} annotated planes found. Ready to send.`,
  },

  result: {
    surface: 'Reconstructed surface',
    ready: 'Done.',
    label: (model: string, at: Date) => `${model}, ${time(at)}`,
  },

  look: {
    colour: 'Colour',
    plain: 'Plain',
    opacity: 'Opacity',
    clipAxis: 'Clip from',
    clipAxes: ['Right side', 'Front', 'Top'],
    clipPlace: 'Clip plane',
    planes: 'Drawn planes',
    reset: 'Reset view',
  },

  figures: {
    volume: 'Volume',
    area: 'Surface area',
    sd: 'Surface uncertainty',
    sdShort: 'Surface SD',
    sdLegend: 'Standard deviation of the surface',
    sdMax: (max: string) => `mean SD; largest ${max} mm`,
    none: 'not known',
    notAsked: 'not asked for',
    typicality: 'Typicality',
    percentile: (value: number) => `${value.toFixed(0)} / 100`,
    typical: (value: number) =>
      value < 0.5
        ? 'unlike anything the model has seen'
        : value < 1
          ? 'rarer than 99 in 100 known shapes'
          : value < 10
            ? 'rarer than nine in ten known shapes'
            : value < 25
              ? 'somewhat unusual'
              : 'usual for this model',
    noInterval: 'no interval asked for',
    interval: (low: string, high: string, unit: string) => `90 %: ${low} to ${high} ${unit}`,
    warnings: 'Before you use this',
    noWarnings: 'No warnings: drawing and shape are within what the model knows.',
    notConverged: (message: string) => `The fit has not settled: ${message}`,
    residuals: (count: number) => `Agreement with each of the ${count} slices`,
    residualHead: ['Slice', '', 'Dice'],
    axis: (axis: number) => `Axis ${'ijk'[axis]}`,
    slice: (plane: string, number: number) => `${plane} ${number}`,
  },

  place: {
    onPlane: (plane: string, slice: number, count: number) => `${plane.toLowerCase()} slice ${slice} of ${count}`,
    onAxis: (axis: number, slice: number) => `slice ${slice} along axis ${'ijk'[axis]}`,
    ofFile: (place: string, file: string) => `${place} of ${file}`,
    file: (number: number) => `file ${number}`,
  },

  slices: {
    title: 'Sections',
    show: 'What the sections show',
    both: 'Segmentation and entropy',
    segmentation: 'Segmentation',
    entropy: 'Entropy',
    entropyLegend: 'Voxel entropy',
    hint: 'Light blue line: edge of the dense segmentation. Green line: the drawing, on slices that hold one. Scroll with the wheel or the slider.',
  },

  files: {
    title: 'Download',
    download: 'Download',
    mesh: (format: string) => `Surface (${format.toUpperCase()})`,
    segmentation: 'Dense segmentation (NIfTI)',
    occupancy: 'Probability (NIfTI)',
    entropy: 'Entropy (NIfTI)',
    sd: 'Surface SD (JSON)',
    summary: 'Summary (JSON)',
    saved: (name: string) => `${name} is saved.`,
  },

  link: {
    title: 'Link to this result',
    copy: 'Copy',
    copied: 'Copied.',
    selected: 'The browser does not copy; the link is selected, press Ctrl+C.',
    until: (date: Date) => `Kept until ${date.toLocaleString('en-GB', { dateStyle: 'medium', timeStyle: 'short' })}.`,
    gone: 'This result is no longer kept, or never was.',
  },

  draw: {
    title: 'Draw',
    how: 'Outline the object on two or more planes. The surface follows as soon as you lift the pen; the orange line is where it crosses a slice.',
    image: 'Image to draw on',
    imageHint: 'A NIfTI volume; it stays in this browser. Without one the grid is empty.',
    clear: 'New empty grid',
    tools: 'Pen',
    kinds: { polygon: 'Contour', brush: 'Brush' },
    erase: 'Erase',
    radius: 'Brush radius',
    undo: 'Undo',
    redo: 'Redo',
    save: 'Download drawing (NIfTI)',
    file: 'drawing.nii.gz',
    keys: 'Arrow keys move the cursor, Space sets a corner or paints, Enter closes the contour, Escape gives it up, Page up and Page down change the slice.',
    onEmpty: 'Drag to outline the object, or click its corners and close at the first one.',
    onImage: (name: string) => `Drawing on ${name}.`,
    oneMore: 'One plane is drawn. Draw on a second one, best across the first.',
    working: (planes: number) => `Fitting ${planes} planes…`,
    done: (planes: number, seconds: number) => `Surface from ${planes} planes in ${seconds.toFixed(2)} s.`,
    finding: (summary: Summary) =>
      `Volume ${summary.volume_ml.value.toFixed(2)} mL` +
      (summary.volume_ml.low === null ? '' : ` (90 %: ${summary.volume_ml.low.toFixed(2)} to ${summary.volume_ml.high!.toFixed(2)})`) +
      `, typicality ${summary.typicality_percentile.toFixed(0)} / 100.`,
    open: 'All figures, sections and files of this result',
    label: (model: string, at: Date) => `${model}, drawn ${time(at)}`,
    suggested: (gain: number) => `Draw this plane next: it is expected to take away ${(100 * gain).toFixed(0)} % of the uncertainty.`,
    goTo: (plane: string, slice: number) => `Go to ${plane.toLowerCase()} slice ${slice}`,
  },

  explore: { title: 'Explore' },

  modes: {
    title: 'Modes of shape',
    how: 'Each slider moves the mean shape along one direction in which shapes of this kind differ, in standard deviations.',
    surface: 'Mean shape, moved by the sliders',
    mode: (rank: number, share: number) => `Mode ${rank} (${(100 * share).toFixed(0)} % of variance)`,
    sd: (value: number) => `${value > 0 ? '+' : ''}${value.toFixed(1).replace('-', '−')} SD`,
    legend: 'Distance from the mean shape',
    reset: 'Back to the mean',
    fine: 'Full resolution.',
  },

  gallery: {
    title: 'Synthetic shapes',
    how: 'Nobody’s anatomy: drawn from the model. The same seed gives the same shape, today and tomorrow.',
    seed: 'First seed',
    temperature: 'Variety (1 is the population’s)',
    more: 'Next shapes',
    drawing: 'Drawing shapes…',
    done: (count: number) => `${count} shapes.`,
    shape: (seed: number) => `Synthetic shape of seed ${seed}`,
    seedOf: (seed: number) => `Seed ${seed}`,
    save: 'STL',
    saveSeed: (seed: number) => `Download shape of seed ${seed} as STL`,
    painter: 'Draws the pictures of the gallery',
  },

  compare: {
    title: 'Two results side by side',
    how: 'Each surface is coloured by how far it lies outside (red) or inside (blue) the other. Both turn together.',
    first: 'First result',
    second: 'Second result',
    placeholder: 'link or identifier',
    run: 'Compare',
    working: 'Measuring…',
    needTwo: 'Choose two results: those made in this tab are offered, links work as well.',
    needOther: 'Both are the same result; choose another one to compare it with.',
    legend: 'Signed distance',
    finding: (mean: number, most: number) => `Distance ${mean.toFixed(2)} mm on average, ${most.toFixed(2)} mm at most.`,
  },
} as const
