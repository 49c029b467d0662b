#version 450

// One texture, one multiplication, one target: on software drivers the pixels determine the frame time.
// Textures and light are both gamma-encoded, since the product of two powers is the power of the product.
// The alpha channel is the label of the pixel, which the material carries as roughness.

layout(set = 2, binding = 0) uniform MaterialBuffer {
  vec4 emission;
  vec4 baseColor;
  float fresnel;
  float roughness;
  float metallic;
  float transmission;
  float ior;
  float transmissionRoughness;
  int textureMask;
  int padding1;
  vec4 textureTransforms[6];
} materialBuffer;

layout(set = 2, binding = 1) uniform sampler2D colorTexture;
layout(set = 2, binding = 2) uniform sampler2D roughnessTexture;
layout(set = 2, binding = 3) uniform sampler2D normalTexture;
layout(set = 2, binding = 4) uniform sampler2D metallicTexture;
layout(set = 2, binding = 5) uniform sampler2D emissionTexture;
layout(set = 2, binding = 6) uniform sampler2D transmissionTexture;

layout(location = 0) in vec2 inUV;
layout(location = 1) in vec3 inLight;

layout(location = 0) out vec4 outColor;

const int GLOWS = 16;

void main() {
  float label = materialBuffer.roughness;
  vec3 color;
  if ((materialBuffer.textureMask & GLOWS) != 0) {
    color = texture(emissionTexture, inUV).rgb * materialBuffer.emission.rgb;
  } else {
    color = texture(colorTexture, inUV).rgb * inLight;
  }
  // Compensates the multiplication by alpha in blending.
  outColor = vec4(color / label, label);
}
