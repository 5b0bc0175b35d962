// The paper's rasterizer (Algorithm 1), as the baseline of rasterize.py: one thread per Gaussian
// walks all pixels, skips those outside a box of r times the picture, and adds to the others
// atomically. Its results differ from run to run in the order of the additions.

struct Gaussian {
    float x, y;                    // centre, output pixels
    float inverse_x, inverse_y;    // 1 / std, output pixels
    float rho, inverse_root;       // 1 / sqrt(1 - rho^2)
    float red, green, blue;
};

__device__ inline Gaussian load(
    const float* mean, const float* std, const float* rho, const float* peak, float scale,
    long long n)
{
    Gaussian g;
    g.x = mean[2 * n] * scale - 0.5f;
    g.y = mean[2 * n + 1] * scale - 0.5f;
    g.inverse_x = 1.0f / (std[2 * n] * scale);
    g.inverse_y = 1.0f / (std[2 * n + 1] * scale);
    g.rho = rho[n];
    g.inverse_root = 1.0f / sqrtf(1.0f - g.rho * g.rho);
    g.red = peak[3 * n];
    g.green = peak[3 * n + 1];
    g.blue = peak[3 * n + 2];
    return g;
}

extern "C" __global__ void paper_forward(
    long long count,
    const float* mean, const float* std,  // [count, 2] source pixels
    const float* rho, const float* peak,  // [count], [count, 3]
    float scale, float box_x, float box_y,  // box: half sides, output pixels
    int width, int height,
    float* pixels)  // [height, width, 3], added to
{
    long long n = (long long)blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= count) return;
    Gaussian g = load(mean, std, rho, peak, scale, n);
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            float dx = x - g.x, dy = y - g.y;
            if (fabsf(dx) > box_x || fabsf(dy) > box_y) continue;
            float t = dy * g.inverse_y;
            float e = (dx * g.inverse_x - g.rho * t) * g.inverse_root;
            float weight = expf(-0.5f * (e * e + t * t));
            float* out = pixels + 3 * ((long long)y * width + x);
            atomicAdd(out, weight * g.red);
            atomicAdd(out + 1, weight * g.green);
            atomicAdd(out + 2, weight * g.blue);
        }
}

extern "C" __global__ void paper_backward(
    long long count,
    const float* mean, const float* std, const float* rho, const float* peak,
    float scale, float box_x, float box_y,
    int width, int height,
    const float* upstream,  // [height, width, 3]
    float* grads)           // [count, 8] out: mean 2, std 2, rho, peak 3
{
    long long n = (long long)blockIdx.x * blockDim.x + threadIdx.x;
    if (n >= count) return;
    Gaussian g = load(mean, std, rho, peak, scale, n);
    float red = 0, green = 0, blue = 0, sum_e = 0, sum_t = 0, ee = 0, et = 0, tt = 0;
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; ++x) {
            float dx = x - g.x, dy = y - g.y;
            if (fabsf(dx) > box_x || fabsf(dy) > box_y) continue;
            float t = dy * g.inverse_y;
            float e = (dx * g.inverse_x - g.rho * t) * g.inverse_root;
            float weight = expf(-0.5f * (e * e + t * t));
            const float* up = upstream + 3 * ((long long)y * width + x);
            red += weight * up[0];
            green += weight * up[1];
            blue += weight * up[2];
            float h = weight * (g.red * up[0] + g.green * up[1] + g.blue * up[2]);
            sum_e += h * e;
            sum_t += h * t;
            ee += h * e * e;
            et += h * e * t;
            tt += h * t * t;
        }
    float tilt = g.rho * g.inverse_root;
    float* out = grads + 8 * n;
    out[0] = scale * sum_e * g.inverse_x * g.inverse_root;
    out[1] = scale * (sum_t - tilt * sum_e) * g.inverse_y;
    out[2] = scale * (ee + tilt * et) * g.inverse_x;
    out[3] = scale * (tt - tilt * et) * g.inverse_y;
    out[4] = (et - tilt * ee) * g.inverse_root;
    out[5] = red;
    out[6] = green;
    out[7] = blue;
}
