// Types of the messages of physion/experiment/protocol.py, for the type check only.

export type Phase = "familiarization" | "test";
/** A name of the list in protocol/stages.py. */
export type Stage = string;

export interface Device {
  user_agent: string;
  refresh_hz: number | null;
  screen_width: number | null;
  screen_height: number | null;
  pixel_ratio: number | null;
  touch: boolean | null;
}

/** Fields with a default may be left out. */
export interface Enter {
  source?: string;
  id?: string;
  visit?: string;
  recruiter?: Record<string, string>;
  scenario?: string;
  condition?: string;
  language?: string;
  pass?: string;
  device?: Device;
}

export interface SessionSettings {
  cue_ms: number;
  flash_hz: number;
  break_every: number;
  familiarization_feedback: boolean;
}

export interface SessionState {
  stage: Stage;
  ended: boolean;
  trial: number | null;
  trials: Record<Phase, number>;
  comprehension_attempts: number;
  practice_repeats: number;
  answered: boolean;
  condition: string;
  settings: SessionSettings;
  scenario: string;
  language: string;
  kind: "person" | "simulated" | "preview";
  buttons: "yes-no" | "no-yes";
  reference: string;
}

export interface Entered {
  token: string;
  state: SessionState;
}

export interface TrialMedia {
  trial: number;
  movie: string;
  map: string;
  frames: number;
  rate: number;
  width: number;
  height: number;
  fixation_ms: number;
  instructed: "yes" | "no" | null;
}

export interface TrialList {
  phase: Phase;
  trials: TrialMedia[];
}

export interface Showing {
  key: string;
  phase: Phase;
  trial: number;
  ago_ms: number;
}

export interface Shown {
  showings: number;
}

export interface Answer {
  key: string;
  phase: Phase;
  trial: number;
  response: "yes" | "no";
  rt_ms: number;
  input: "mouse" | "touch" | "keyboard";
  fixation_ms: number | null;
  cue_ms: number | null;
  frames_shown: number | null;
  frames_dropped: number | null;
  movie_ms: number | null;
  visibility_changes: number | null;
  window_width: number | null;
  window_height: number | null;
  break_ms: number | null;
  void: "hidden" | "dialog" | "window" | null;
  details: Record<string, any>;
}

export interface Feedback {
  contact: boolean;
  correct: boolean;
  movie: string;
  frames: number;
}

export interface AnswerStored {
  duplicate: boolean;
  feedback: Feedback | null;
  state: SessionState;
}

export interface Event {
  kind: string;
  at_ms: number;
  data: Record<string, boolean | number | string | null>;
}

export interface Events {
  key: string | null;
  events: Event[];
}

export interface Completion {
  code: string | null;
  url: string | null;
  post: Record<string, string> | null;
  withheld: boolean;
}

export interface SessionEnd {
  completion: Completion;
}

export interface Result {
  correct: number;
  trials: number;
  accuracy: number;
  percentile: number | null;
  completion: Completion;
}

export interface Recruiter {
  source: string;
  id: string;
  others: string[];
  preview: Record<string, string>;
}

export interface AskedQuestion {
  name: string;
  kind: "text" | "choice" | "choices" | "scale";
  required: boolean;
  options: string[];
  steps: number;
  picture: string;
}

export interface PaidAmount {
  amount: number;
  currency: string;
}

export interface CheckedQuestion {
  name: string;
  options: string[];
}

export interface PublicStudy {
  title: string;
  contact: string;
  languages: string[];
  consent_version: string;
  consent_files: string[];
  funders: string;
  payment: PaidAmount | null;
  expected_minutes: number;
  scenarios: string[];
  id_needed: boolean;
  min_width: number;
  min_height: number;
  fullscreen: boolean;
  cue_ms: number;
  flash_hz: number;
  break_every: number;
  familiarization_feedback: boolean;
  hold_minutes: number;
  preload: number;
  interrupted: "repeat" | "void";
  comprehension_questions: CheckedQuestion[];
  comprehension_limit: number;
  practice_min_correct: number;
  questions: AskedQuestion[];
  example: Record<string, TrialMedia>;
  recruiters: Recruiter[];
  device_refused: Record<string, Completion>;
}

export interface Refusal {
  error: string;
  message: string;
  state: SessionState | null;
  completion: Completion | null;
}

declare global {
  interface Window {
    /** Globals of vendor/jspsych.min.js. */
    jsPsychModule: any;
    initJsPsych: (options: object) => any;
  }
}
