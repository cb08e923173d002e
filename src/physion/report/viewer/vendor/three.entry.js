// What the viewer uses of three.js; rebuild.py makes three.min.js of it.
export {
  AnimationMixer, BufferAttribute, BufferGeometry, Color, DirectionalLight, HemisphereLight,
  Line, LineBasicMaterial, LineSegments, PerspectiveCamera, Points, PointsMaterial, Scene,
  Spherical, SRGBColorSpace, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
