// Renders a binary .ply of 3D Gaussians to a PNG of 640 x 480 without Python: render_ply IN.ply OUT.png
#include <algorithm>
#include <cmath>
#include <fstream>
#include <iostream>
#include <map>
#include "gsim3d/raster/raster.h"
using Bytes = std::string;
constexpr int64_t W = 640, H = 480, kRow = 3 * W + 1;  // bytes of a row of a PNG
Bytes big(uint32_t x) { return {char(x >> 24), char(x >> 16), char(x >> 8), char(x)}; }
Bytes chunk(const Bytes& body) {
  uint32_t crc = ~0u;
  for (size_t bit = 0; bit < 8 * body.size(); ++bit)
    crc = crc >> 1 ^ ((crc ^ body[bit / 8] >> bit % 8) & 1 ? 0xEDB88320u : 0);
  return big(uint32_t(body.size() - 4)) + body + big(~crc);
}
Bytes png(const std::vector<float>& image) {
  Bytes data = "\x78\x01";
  uint32_t a = 1, b = 0;
  for (int64_t y = 0; y < H; ++y) {  // each row of pixels is a block that is not compressed
    Bytes row(1, '\0');
    for (int64_t x = 0; x < 3 * W; ++x) row += char(std::lround(255 * std::clamp(image[3 * W * y + x], 0.0f, 1.0f)));
    for (unsigned char byte : row) a = (a + byte) % 65521, b = (b + a) % 65521;
    data += Bytes{char(y + 1 == H), char(kRow), char(kRow >> 8), char(~kRow), char(~kRow >> 8)} + row;
  }
  return "\x89PNG\r\n\x1a\n" + chunk("IHDR" + big(W) + big(H) + Bytes{8, 2, 0, 0, 0}) +
         chunk("IDAT" + data + big(b << 16 | a)) + chunk("IEND");
}
int main(int argc, char** argv) {
  std::ifstream file(argc == 3 ? argv[1] : "", std::ios::binary);
  std::map<Bytes, size_t> column;
  int64_t n = 0;
  for (Bytes word, type; file >> word && word != "end_header" && word != "mip";)
    if (word == "ascii" || word == "binary_big_endian" || (word == "antialiased" && file >> word && word == "1")) break;
    else if (word == "vertex") file >> n;
    else if (word == "property" && file >> type >> word) column.emplace(word, column.size()), n *= type == "float";
  std::vector<float> rows(n * column.size()), means, quats, scales, opacities, color, low(3, 1e9f), high(3, -1e9f);
  if (!n || !file.ignore() || !file.read((char*)rows.data(), rows.size() * 4) || !column.count("rot_3"))
    return std::cerr << "usage: render_ply IN.ply OUT.png, a little-endian .ply of floats, not of Mip-Splatting\n", 1;
  for (const float* row = rows.data(); row != rows.data() + rows.size(); row += column.size()) {
    for (const char* name : {"x", "y", "z"}) means.push_back(row[column.at(name)]);
    for (const char* name : {"rot_0", "rot_1", "rot_2", "rot_3"}) quats.push_back(row[column.at(name)]);
    for (const char* name : {"scale_0", "scale_1", "scale_2"}) scales.push_back(std::exp(row[column.at(name)]));
    for (const char* name : {"f_dc_0", "f_dc_1", "f_dc_2"}) color.push_back(.5f + .2820948f * row[column.at(name)]);
    opacities.push_back(1 / (1 + std::exp(-row[column.at("opacity")])));
    for (int k = 0; k < 3; ++k) low[k] = std::min(low[k], row[k]), high[k] = std::max(high[k], row[k]);
  }
  const float x = (low[0] + high[0]) / 2, y = (low[1] + high[1]) / 2, side = std::max(high[0] - x, high[1] - y);
  const float viewmat[] = {1, 0, 0, -x, 0, 1, 0, -y, 0, 0, 1, 2 * side - low[2], 0, 0, 0, 1}, black[3] = {};
  const float K[] = {H / 1.5f, 0, W / 2.f, 0, H / 1.5f, H / 2.f, 0, 0, 1};
  const int64_t image_cloud[] = {0}, cu_rows[] = {0, n};
  std::vector<float> image(3 * W * H), alpha(W * H), depth(W * H), light(W * H);
  std::vector<int32_t> last(W * H);
  gsim3d::HeapWorkspace workspace;
  gsim3d::cpu::raster_forward<float>(
      {means.data(), quats.data(), scales.data(), opacities.data(), color.data(), nullptr, black, viewmat, K,
       image_cloud, cu_rows, n, 1, 1, 0, 0, W, H, 1e-3f, gsim3d::RasterCutoff::kExact},
      {image.data(), alpha.data(), depth.data(), nullptr, light.data(), last.data()}, workspace, gsim3d::thread_pool());
  std::ofstream(argv[2], std::ios::binary) << png(image);
}
