#version 450

// Lighting per vertex: walls and floors are flat, so all their pixels would give the same result.

// SAPIEN passes the number of lights to fragment shaders only, so it is fixed here.
const int LIGHTS = 3;
const float PI = 3.141592653589793;
const float GAMMA = 2.2;

layout(set = 0, binding = 0) uniform CameraBuffer {
  mat4 viewMatrix;
  mat4 projectionMatrix;
  mat4 viewMatrixInverse;
  mat4 projectionMatrixInverse;
  float width;
  float height;
} cameraBuffer;

layout(set = 1, binding = 0) uniform ObjectTransformBuffer {
  mat4 modelMatrix;
} objectTransformBuffer;

layout(set = 1, binding = 1) uniform ObjectDataBuffer {
  uvec4 segmentation;
  float transparency;
  int shadeFlat;
} objectDataBuffer;

struct PointLight { vec4 position; vec4 emission; };
struct DirectionalLight { vec4 direction; vec4 emission; };
struct SpotLight { vec4 position; vec4 direction; vec4 emission; };

layout(set = 3, binding = 0) uniform SceneBuffer {
  vec4 ambientLight;
  PointLight pointLights[10];
  DirectionalLight directionalLights[LIGHTS];
  SpotLight spotLights[10];
  SpotLight texturedLights[1];
} sceneBuffer;

layout(location = 0) in vec3 position;
layout(location = 1) in vec3 normal;
layout(location = 2) in vec2 uv;

layout(location = 0) out vec2 outUV;
layout(location = 1) out vec3 outLight;

void main() {
  vec4 world = objectTransformBuffer.modelMatrix * vec4(position, 1.0);
  gl_Position = cameraBuffer.projectionMatrix * (cameraBuffer.viewMatrix * world);
  outUV = uv;
  vec3 outward = mat3(objectTransformBuffer.modelMatrix) * normal;
  vec3 light = sceneBuffer.ambientLight.rgb;
  for (int i = 0; i < LIGHTS; ++i) {
    float facing = max(dot(outward, -sceneBuffer.directionalLights[i].direction.xyz), 0.0);
    light += sceneBuffer.directionalLights[i].emission.rgb * (facing / PI);
  }
  outLight = pow(light, vec3(1.0 / GAMMA));
}
