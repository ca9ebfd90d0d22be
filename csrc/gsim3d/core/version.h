#pragma once

#define GSIM3D_VERSION "0.2.0"
