// What reports/report_data.py writes and the page reads.

export interface Index {
  scenarios: string[]; families: string[]; titles: string[]; engines: string[]; engine_titles: string[];
  verdicts: string[]; glyphs: string[]; slugs: string[]; reasons: string[];
  levels: string[]; integrators: string[]; quantitys: string[];
  commit: string | null; passed: string | null;
  rows: {
    scenario: Uint16Array; engine: Uint8Array; verdict: Uint8Array; level: Uint8Array; integrator: Uint8Array;
    quantity: Uint16Array; severity: Uint8Array; fresh: Uint8Array; ratio: Uint16Array;
  };
}

export interface RowDetail {
  unit?: string; value?: number | null; tolerance?: number | null; uncertainty?: number | null; compared_until?: number | null;
  order?: number | null; declared_order?: number; alias_of?: string; known_issue?: string; is_declared?: boolean; diagnosis?: string; user_rtol?: number;
  cpu_time?: number; derivation?: string; extra?: Record<string, number | null>; script?: string; engine_version?: string;
}

export interface CurveSet {
  engine: string; integrator: string; resolution: number; t: Float32Array; crossing?: number;
  tolerance?: Uint16Array; judged?: string; limit_error?: Uint16Array; position_error?: Uint16Array; attitude_error?: Uint16Array; energy_drift?: Uint16Array;
  momentum_drift?: Uint16Array; joint_gap?: Uint16Array; gap_rate?: Uint16Array; norm_drift?: Uint16Array;
}

export type Vec = [number, number, number];
/** Whether the joint leaves its body free, and whether its points part; far body (−1 the world) and point, near body and point, and joint axes in both; joints that close loops have no half. */
export interface Shape { is_free: boolean; is_apart: boolean; far: number; body: number; hang: Vec; near: Vec; far_axes: Vec[]; near_axes: Vec[]; axes: Vec[]; half: Vec }
export interface MotionData {
  t: Float32Array; bodies: number; base: [string, string]; span: number; r: Int16Array; p: Int16Array; shape: Shape[];
  runs: { engine: string; integrator: string; scale: Float32Array; d: Int8Array }[];
}

/** When runs leave the proved motion by more than `distance` [m], in s; null where they do not until the end. */
export interface Departures {
  distance: number;
  runs: { engine: string; integrator: string; kind: "step" | "tolerance"; resolution: number; left: number | null; until: number }[];
}

export interface StateSpread { engine: string; quantity: string; ratio: Uint16Array; worst: [number, number]; bound: number; error: number }

export interface ScenarioChunk {
  scenario: {
    family: string; title: string; purpose: string; file: string; bodies: number; joints: string[]; duration: number;
    sample: number; exact: string | null | boolean; horizon: number | null; truth_uncertainty: number | null; digest: string; truth: string | null;
    loops: { closing: string[]; rows: number; independent: number; determinate: number[] } | null;
  };
  rows: Record<string, RowDetail>; commands: Record<string, string>;
  departures: Departures | null; states: StateSpread[]; curves: CurveSet[] | null; motion: MotionData | null;
}

/** As it is stored: the rows in order, and by how much the place of each in the index exceeds the one before. */
export type PackedScenario = Omit<ScenarioChunk, "rows"> & { places: number[]; rows: RowDetail[] };

export interface Study {
  scenario: string; engine: string; integrator: string; quantity: string; kind: "step" | "tolerance"; declared: number | null;
  alias: string | null; resolution: (number | null)[]; error: (number | null)[]; cost: (number | null)[]; order: (number | null)[];
}

export interface HistoryChunk {
  nights: { id: string; started: string; commit: string | null; versions: Record<string, string>; exit_code: number; sentence: string }[];
  damaged: string[]; value: Uint16Array; ratio: Uint16Array; verdict: Uint8Array;
}
