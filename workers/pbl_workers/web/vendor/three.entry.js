// What the page takes of three.js; README.md says how three-0.187.0.min.js is made from it.
export {
  AmbientLight, BufferGeometry, CapsuleGeometry, Color, DirectionalLight, Float32BufferAttribute, Line, LineBasicMaterial, LineSegments, Mesh,
  MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera, Quaternion, Scene, Vector3, WebGLRenderer,
} from "three";
