//! A layer's name, the shapes of its parameters, and their initial distribution.
//! `config` decides which layers a network has.

use rand_chacha::ChaCha8Rng;

use crate::init::Initializer;

/// The parameters of a linear layer: weight [out, in] and bias [out].
#[derive(Clone, Debug)]
pub(crate) struct Layer<T> {
    pub(crate) weight: T,
    pub(crate) bias: T,
}

/// A layer's name, the shapes of its parameters, and their initial distribution.
///
/// Source of the distributions: the paper authors' code. An orthogonal C51 head would double the initial Q
/// values, and a target network updated once in 312 updates would keep them beyond 100,000 frames.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct LayerSpec {
    pub(crate) name: String,
    pub(crate) weight_shape: Vec<usize>,
    pub(crate) has_bias: bool,
    pub(crate) initializer: Initializer,
    /// The factor applied to the weight after drawing.
    pub(crate) initial_scale: f32,
    /// sigma_0 if the layer is noisy: weight and bias are then a mean and a sigma each.
    pub(crate) noisy_sigma: Option<f64>,
    /// Locations of one state at which the layer is applied.
    pub(crate) locations: usize,
    /// Columns of the weight for the joined input, which is the same at all locations and multiplied once.
    pub(crate) joined_width: usize,
}

impl LayerSpec {
    /// A layer with a bias, applied once a state, of a weight [out, in] or [out, in, k, k].
    pub(crate) fn new(name: impl Into<String>, weight: &[usize], initializer: Initializer) -> Self {
        Self {
            name: name.into(),
            weight_shape: weight.to_vec(),
            has_bias: true,
            initializer,
            initial_scale: 1.0,
            noisy_sigma: None,
            locations: 1,
            joined_width: 0,
        }
    }

    /// The layers of a residual block on `inputs` features and `joined` features. The skip layer has no bias
    /// and starts orthogonal, whatever `initializer` says for the other two.
    pub(crate) fn block(
        name: &str,
        locations: usize,
        [inputs, joined, outputs]: [usize; 3],
        initializer: Initializer,
    ) -> [Self; 3] {
        let layer = |part: &str, [inputs, joined]: [usize; 2], initializer| Self {
            locations,
            joined_width: joined,
            ..Self::new(
                format!("{name}.{part}"),
                &[outputs, inputs + joined],
                initializer,
            )
        };
        let mut skip = layer("skip", [inputs, joined], Initializer::Orthogonal);
        skip.has_bias = false;
        [
            layer("hidden", [inputs, joined], initializer),
            layer("out", [outputs, 0], initializer),
            skip,
        ]
    }

    /// Names and shapes of the layer's parameters, in the order in which they are drawn.
    pub(crate) fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        let name = &self.name;
        let suffixes: &[&str] = match self.noisy_sigma {
            None => &[""],
            Some(_) => &["_mu", "_sigma"],
        };
        let weights = suffixes
            .iter()
            .map(|suffix| (format!("{name}.weight{suffix}"), self.weight_shape.clone()));
        let biases = suffixes
            .iter()
            .map(|suffix| (format!("{name}.bias{suffix}"), vec![self.weight_shape[0]]));
        let biases = biases.filter(|_| self.has_bias);
        weights.chain(biases).collect()
    }

    /// Draws the initial values of [`LayerSpec::parameters`]. A sigma is not drawn: it is sigma_0 / sqrt(fan_in).
    ///
    /// Source: Fortunato et al. 2018, section 3.2 (b).
    pub(crate) fn draw_initial_values(&self, rng: &mut ChaCha8Rng) -> Vec<Vec<f32>> {
        let shape = &self.weight_shape;
        let mut weight = self.initializer.draw_weight(shape, rng);
        weight.iter_mut().for_each(|it| *it *= self.initial_scale);
        let outputs = shape[0];
        let sigma = self.noisy_sigma.map(|sigma_0| {
            let fan_in = weight.len() / outputs;
            (sigma_0 / (fan_in as f64).sqrt()) as f32
        });
        let sigmas = |len: usize| sigma.map(|sigma| vec![sigma; len]);
        let weight_sigmas = sigmas(weight.len());
        let draw_bias = || self.initializer.draw_bias(shape, rng);
        let bias = self.has_bias.then(draw_bias);
        let bias_sigmas = bias.is_some().then(|| sigmas(outputs)).flatten();
        let values = [Some(weight), weight_sigmas, bias, bias_sigmas];
        values.into_iter().flatten().collect()
    }
}
