//! A layer's name, the shapes of its parameters, and their initial distribution.
//! `config` decides which layers a network has.

use rand_chacha::ChaCha8Rng;

use crate::init::InitialLaw;

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
pub(crate) struct LayerShape {
    pub(crate) name: String,
    pub(crate) weight: Vec<usize>,
    pub(crate) bias: bool,
    pub(crate) initial: InitialLaw,
    /// The factor applied to the weight after drawing.
    pub(crate) initial_scale: f32,
    /// sigma_0 if the layer is noisy: weight and bias are then a mean and a sigma each.
    pub(crate) noisy_sigma: Option<f64>,
    /// Locations of one state at which the layer is applied.
    pub(crate) locations: usize,
    /// Columns of the weight for the joined input, which is the same at all locations and multiplied once.
    pub(crate) joined: usize,
}

impl LayerShape {
    /// A layer with a bias, applied once a state, of a weight [out, in] or [out, in, k, k].
    pub(crate) fn new(name: impl Into<String>, weight: &[usize], initial: InitialLaw) -> Self {
        Self {
            name: name.into(),
            weight: weight.to_vec(),
            bias: true,
            initial,
            initial_scale: 1.0,
            noisy_sigma: None,
            locations: 1,
            joined: 0,
        }
    }

    /// The layers of a residual block on `inputs` features and `joined` features. The skip layer has no bias
    /// and starts orthogonal, whatever `initial` says for the other two.
    pub(crate) fn block(
        name: &str,
        locations: usize,
        [inputs, joined, outputs]: [usize; 3],
        initial: InitialLaw,
    ) -> [Self; 3] {
        let layer = |part: &str, [inputs, joined]: [usize; 2], initial| Self {
            locations,
            joined,
            ..Self::new(
                format!("{name}.{part}"),
                &[outputs, inputs + joined],
                initial,
            )
        };
        let skip = layer("skip", [inputs, joined], InitialLaw::Orthogonal);
        [
            layer("hidden", [inputs, joined], initial),
            layer("out", [outputs, 0], initial),
            Self {
                bias: false,
                ..skip
            },
        ]
    }

    /// Names and shapes of the layer's parameters, in the order in which they are drawn.
    pub(crate) fn parameters(&self) -> Vec<(String, Vec<usize>)> {
        let name = &self.name;
        let ends: &[&str] = match self.noisy_sigma {
            None => &[""],
            Some(_) => &["_mu", "_sigma"],
        };
        let weights = ends
            .iter()
            .map(|end| (format!("{name}.weight{end}"), self.weight.clone()));
        let biases = ends
            .iter()
            .map(|end| (format!("{name}.bias{end}"), vec![self.weight[0]]));
        let biases = biases.filter(|_| self.bias);
        weights.chain(biases).collect()
    }

    /// Draws the initial values of [`LayerShape::parameters`]. A sigma is not drawn: it is sigma_0 / sqrt(fan_in).
    ///
    /// Source: Fortunato et al. 2018, section 3.2 (b).
    pub(crate) fn initial_values(&self, rng: &mut ChaCha8Rng) -> Vec<Vec<f32>> {
        let mut weight = self.initial.weight(&self.weight, rng);
        weight.iter_mut().for_each(|it| *it *= self.initial_scale);
        let outputs = self.weight[0];
        let sigma = self.noisy_sigma.map(|sigma_0| {
            let fan_in = weight.len() / outputs;
            (sigma_0 / (fan_in as f64).sqrt()) as f32
        });
        let sigmas = |len: usize| sigma.map(|sigma| vec![sigma; len]);
        let weight_sigmas = sigmas(weight.len());
        let bias = self.bias.then(|| self.initial.bias(&self.weight, rng));
        let bias_sigmas = bias.is_some().then(|| sigmas(outputs)).flatten();
        let values = [Some(weight), weight_sigmas, bias, bias_sigmas];
        values.into_iter().flatten().collect()
    }
}
