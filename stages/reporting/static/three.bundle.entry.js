export { WebGLRenderer, Scene, PerspectiveCamera, Color, Group, Mesh, SkinnedMesh, MeshStandardMaterial, MeshBasicMaterial,
  MeshNormalMaterial, LineBasicMaterial, LineSegments, Points, PointsMaterial, BufferGeometry, BufferAttribute,
  Float32BufferAttribute, HemisphereLight, DirectionalLight, AmbientLight, AnimationMixer, AnimationUtils, Box3, Vector3,
  Quaternion, Matrix4, GridHelper, CylinderGeometry, OctahedronGeometry, SphereGeometry, CircleGeometry, InstancedMesh, LoopRepeat, LoopOnce,
  SRGBColorSpace, DoubleSide, FrontSide, Clock, CameraHelper, PCFSoftShadowMap, ShadowMaterial, PlaneGeometry, ACESFilmicToneMapping, NoToneMapping } from 'three';
export { OrbitControls } from 'three/examples/jsm/controls/OrbitControls.js';
export { GLTFLoader } from 'three/examples/jsm/loaders/GLTFLoader.js';
