#pragma once

#define GSIM3D_VERSION "0.1.0"
